"""Measurements of softfin's own parts for README, docs and `results`."""
