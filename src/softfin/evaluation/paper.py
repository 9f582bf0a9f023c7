"""Scores printed in the paper: Table I, and Table II with x error, x std, y error and y std [N] in
each row.

The last row of Table II, "Overall mean", is not always the mean of the rows above: for the grid,
the printed y std is 0.201, but the mean of the rows is 0.293.
"""

PaperScores = tuple[float, float, float, float]

PAPER_TABLE_I = {
    "posnet": {"window": 100, "parameters": 113_601, "rmse": 0.03, "mae": 0.002, "dtw": 0.002},
    "forcenet": {"window": 100, "parameters": 129_794, "rmse": 0.2, "mae": 0.04, "dtw": 0.03},
}
"""Scores by network; the paper states neither units nor the normalisation of DTW."""

PAPER_TABLE_II: dict[str, dict[tuple[float, float], PaperScores]] = {
    "single": {
        (1, -1): (1.07, 0.458, 0.871, 0.317),
        (2, -1): (0.953, 0.436, 0.351, 0.274),
        (2, 0): (0.419, 0.281, 0.369, 0.269),
        (3, 0): (0.394, 0.338, 1.12, 0.386),
        (1, 1): (1.11, 0.515, 0.690, 0.381),
        (2, 1): (1.02, 0.421, 0.714, 0.727),
    },
    "grid": {
        (1, -1): (0.532, 0.520, 0.382, 0.362),
        (2, -1): (0.298, 0.218, 0.935, 0.207),
        (2, 0): (0.307, 0.274, 0.520, 0.463),
        (3, 0): (0.467, 0.402, 0.830, 0.331),
        (1, 1): (0.440, 0.220, 0.302, 0.214),
        (2, 1): (0.696, 0.369, 0.269, 0.182),
    },
}
"""Scores by controller and reference force [N], as measured on the real fin."""

PAPER_PRINTED_MEANS: dict[str, PaperScores] = {
    "single": (0.828, 0.408, 0.685, 0.392),
    "grid": (0.435, 0.325, 0.537, 0.201),
}
"""The row "Overall mean" as printed."""
