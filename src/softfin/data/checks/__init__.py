"""Checks of logs before a surrogate is fitted to them."""
