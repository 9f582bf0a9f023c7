"""Definitions that all packages share: quantities, action clock, plant contract, configuration and
errors."""
