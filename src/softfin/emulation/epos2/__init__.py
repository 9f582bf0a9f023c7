"""An emulated EPOS2: its object dictionary, its states and motion, and its place on a CAN bus."""
