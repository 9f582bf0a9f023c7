"""Streaming surrogates: recurrent networks that run at 100 Hz with a constant cost per tick."""
