"""Logs: excitation and collection, import of recordings, checks."""
