"""The page to try controllers in, as one HTML file."""
