"""Baselines that need no training: open-loop search and inverse model."""
