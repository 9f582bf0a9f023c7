"""The stages of the pipeline as functions that read and write folders: the Python API."""
