"""Training: policies learn the task inside a plant, many at once in one compiled program."""
