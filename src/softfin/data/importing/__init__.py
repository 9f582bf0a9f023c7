"""Recordings in other formats become logs at 100 Hz."""
