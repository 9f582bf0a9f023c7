"""Checks that logs pass before a surrogate is fitted to them."""
