"""Animations of a fin: its bent shape, its force and their traces, as a video or an HTML page."""
