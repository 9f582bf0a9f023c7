"""Animations of a fin: its bent shape, its force and their traces, as a film or a page."""
