"""The page to try controllers, as one HTML file."""
