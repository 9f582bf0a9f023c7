"""Fits the virtual tank to logs or to another plant, and estimates how well each parameter is
determined."""
