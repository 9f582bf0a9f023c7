"""Robots with several fins on one body: forces and torques asked for, fins that make them, control
of motion."""
