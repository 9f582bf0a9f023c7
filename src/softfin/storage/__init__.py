"""What lies on disk: artifacts, run directories, logs, datasets, bags; and finding a plant by its name."""
