"""Emulated drives and sensors around the virtual tank, in simulated or real time."""
