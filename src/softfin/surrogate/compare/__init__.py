"""Comparison of surrogates on test logs: free runs, scores and a report."""
