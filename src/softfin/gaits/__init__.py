"""Gaits (periodic motions), their mean forces, and the region of forces that a fin can produce."""
