"""Log data: excitation, collection, import of recordings, and checks."""
