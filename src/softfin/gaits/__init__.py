"""Gaits (periodic motions), their mean forces, and the region of reachable forces."""
