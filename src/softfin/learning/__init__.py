"""Training: many policies learn the task in a plant together, in one compiled program."""
