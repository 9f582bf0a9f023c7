"""The page for trying controllers, as one HTML file."""
