"""A three-dimensional page of a robot's trial."""
