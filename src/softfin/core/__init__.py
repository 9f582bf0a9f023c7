"""Shared definitions: quantities, action clock, plants, configuration, errors."""
