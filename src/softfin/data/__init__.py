"""Log data: excitation, collection, import and checks."""
