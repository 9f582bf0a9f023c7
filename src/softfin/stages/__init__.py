"""The stages of the main job as functions of folders: the Python API."""
