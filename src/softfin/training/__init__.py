"""Training: force-tracking policies learn inside a plant, many lanes at once in one compiled program."""
