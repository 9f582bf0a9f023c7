"""Files on disk: artifacts, run directories, logs, datasets, bags; and plants found by their
names."""
