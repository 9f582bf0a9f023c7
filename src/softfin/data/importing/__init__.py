"""Converts recordings in other formats to logs at 100 Hz."""
