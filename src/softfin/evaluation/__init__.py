"""How well a controller holds a reference force: experiment, scores, figures, report (paper Sec. IV, Table II)."""
