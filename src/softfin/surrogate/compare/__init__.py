"""Comparison of surrogates on test logs."""
