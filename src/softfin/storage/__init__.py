"""Files on disk: artifacts, run directories, logs, datasets and bags. Also finds plants by name."""
