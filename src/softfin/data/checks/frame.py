"""Which way the force's axes lie: what a fin must do, compared with every way to swap and turn the measured axes.

Thrust points along (cos theta, -sin theta) and grows with the square of the rate; added mass and drag act across it,
along (sin theta, cos theta), against acceleration and rate. No term may change its sign, so a turned axis shows.
"""

import itertools

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ
from softfin.data.checks.alignment import motion, smoothed
from softfin.data.importing.importing import FORCE_FRAMES


def frame_correlations(
    angle: Float[np.ndarray, "ticks"], force: Float[np.ndarray, "ticks 2"], lag_ms: float | int = 0.0
) -> dict[str, float]:
    """Compute the correlation of the force, taken in each of `FORCE_FRAMES`, with the best fit of a model fin."""
    ticks = round(lag_ms * RATE_HZ / 1e3)
    terms = _terms(angle)
    smooth = np.stack([smoothed(force[:, 0]), smoothed(force[:, 1])])
    count = len(angle) - abs(ticks)
    terms = terms[:, max(-ticks, 0) :][:, :count]
    smooth = smooth[:, max(ticks, 0) :][:, :count]
    terms = terms - terms.mean(axis=1, keepdims=True)
    smooth = smooth - smooth.mean(axis=1, keepdims=True)
    # Axis by axis: every frame is made of these products, so that the rows are gone through once.
    products = np.einsum("xtk,yt->xyk", terms, smooth)
    scale = np.sqrt((terms**2).sum(axis=(0, 1))) + 1e-12
    gram = np.einsum("xtk,xtl->kl", terms, terms) / np.outer(scale, scale)
    norm = float(np.sqrt((smooth**2).sum())) + 1e-12
    result = {}
    for frame in FORCE_FRAMES:
        signs = [(-1.0 if part.startswith("-") else 1.0, "xy".index(part[-1])) for part in frame.split(",")]
        product = sum(sign * products[axis, source] for axis, (sign, source) in enumerate(signs)) / scale
        result[frame] = _best(gram, np.asarray(product)) / norm
    return result


def _terms(angle: Float[np.ndarray, "ticks"]) -> Float[np.ndarray, "2 ticks terms"]:
    theta, rate, acceleration = motion(angle)
    cos, sin = np.cos(theta), np.sin(theta)
    across, along = np.stack([sin, cos]), np.stack([cos, -sin])
    columns = [-rate * np.abs(rate) * across, -acceleration * across, rate**2 * along, np.abs(rate) * along]
    return np.stack(columns, axis=-1)


def _best(gram: Float[np.ndarray, "terms terms"], product: Float[np.ndarray, "terms"]) -> float:
    """Norm of the least-squares fit whose coefficients are none below 0; so few terms that every choice is tried."""
    best = 0.0
    for chosen in itertools.chain.from_iterable(itertools.combinations(range(len(gram)), n) for n in (1, 2, 3, 4)):
        index = list(chosen)
        weights = np.linalg.lstsq(gram[np.ix_(index, index)], product[index], rcond=1e-9)[0]
        if (weights >= 0).all():
            best = max(best, float(weights @ product[index]))
    return float(np.sqrt(best))
