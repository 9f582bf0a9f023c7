"""Streaming surrogates: networks with a state, which step at 100 Hz at a constant cost per tick."""
