"""Experiments: scores, figures and report (paper Sec. IV)."""
