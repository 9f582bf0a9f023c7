"""Shared by all rooms: quantities, the action clock, the plant contract, configuration, errors."""
