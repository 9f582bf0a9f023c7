"""How logs come about: excitation and collection, import of recordings, checks."""
