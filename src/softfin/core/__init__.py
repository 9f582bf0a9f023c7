"""Shared by all packages: quantities, the action clock, the plant contract, configuration,
errors."""
