"""Commissioning of a real rig: eight signed steps before anybody relies on it
(docs/commissioning.md)."""
