"""Surrogates compared on test logs."""
