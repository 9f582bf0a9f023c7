"""Training of many policies in a plant, in one compiled program."""
