"""Import recordings in other formats as logs at 100 Hz."""
