"""Robots with several fins on one body: allocation of a wrench to the fins, and motion control."""
