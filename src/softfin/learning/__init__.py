"""Policies are trained inside a plant, many at once in one compiled program."""
