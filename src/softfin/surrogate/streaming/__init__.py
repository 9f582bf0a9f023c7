"""Streaming surrogates: networks with a state of their own that step at 100 Hz at a constant cost a
tick."""
