"""Periodic motions, the mean forces that they make, and the region of all that a fin can make."""
