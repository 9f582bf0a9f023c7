"""Three-dimensional HTML page of a robot's trial."""
