"""Experiments: scores, figures, report (paper Sec. IV)."""
