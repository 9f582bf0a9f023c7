"""A recording watched while it is made: its file is followed, on this computer or another, and
never written to."""
