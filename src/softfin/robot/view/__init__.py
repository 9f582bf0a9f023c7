"""A robot's trial as a page in three dimensions."""
