"""Fits the virtual tank to logs or to a different plant, and estimates the uncertainty of each
parameter."""
