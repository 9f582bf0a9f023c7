"""Fitting the virtual tank to logs or to another plant, and saying how well each of its parameters
is determined."""
