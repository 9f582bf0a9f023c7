"""The 95% interval of a mean of few values, by Student's t."""

import math

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

CONFIDENCE = 0.95


def interval(values: Float[np.ndarray, "samples"]) -> list[float] | None:
    """[low, high] of the mean over independent samples; None where there are fewer than two."""
    n = len(values)
    if n < 2:
        return None
    half = float(stdtrit(n - 1, (1 + CONFIDENCE) / 2)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    mean = float(np.mean(values))
    return [mean - half, mean + half]
