"""Baselines that need no training: open-loop search, inverse model, and RecurrentPPO."""
