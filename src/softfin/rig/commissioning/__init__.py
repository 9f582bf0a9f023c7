"""Commissioning of a real rig: eight signed steps before you rely on it (docs/commissioning.md)."""
