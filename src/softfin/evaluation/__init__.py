"""Experiments with controllers: scores, baselines, figures, report (paper Sec. IV)."""
