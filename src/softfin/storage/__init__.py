"""Files on disk: artifacts, run directories, logs, datasets and bags. This package also finds
plants by name."""
