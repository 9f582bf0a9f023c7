"""The outlines that are drawn: a bent fin with its thickness, and an arrow. Points in, a polygon out; all in metres."""

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "points 2"]

PIECES = 6
"""Straight pieces drawn between two points of the fin."""


def smooth(points: Points) -> Float[np.ndarray, "pieces 2"]:
    """A curve through the points (Catmull and Rom 1974); a line of two points stays as it is."""
    if len(points) < 3:
        return points
    before = np.concatenate([2 * points[:1] - points[1:2], points[:-1]])[:-1]
    after = np.concatenate([points[1:], 2 * points[-1:] - points[-2:-1]])[1:]
    start, stop = points[:-1], points[1:]
    u = np.linspace(0, 1, PIECES, endpoint=False)[None, :, None]
    leave, arrive = ((stop - before) / 2)[:, None], ((after - start) / 2)[:, None]
    curve = (
        (2 * u**3 - 3 * u**2 + 1) * start[:, None]
        + (3 * u**2 - 2 * u**3) * stop[:, None]
        + (u**3 - 2 * u**2 + u) * leave
        + (u**3 - u**2) * arrive
    )
    return np.concatenate([curve.reshape(-1, 2), points[-1:]])


def fin_outline(middle: Points, thickness: Float[np.ndarray, " points"]) -> Float[np.ndarray, "corners 2"]:
    """Of a fin with `thickness` at the points of its middle line, smoothed, with a rounded tip."""
    line = smooth(middle)
    half = np.interp(np.linspace(0, 1, len(line)), np.linspace(0, 1, len(thickness)), thickness) / 2
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    offset = half[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
    turn = np.linspace(np.pi / 2, -np.pi / 2, 9)[1:-1, None]
    normal = np.stack([-along[-1, 1], along[-1, 0]])
    tip = line[-1] + half[-1] * (np.sin(turn) * normal + np.cos(turn) * along[-1])
    return np.concatenate([line + offset, tip, (line - offset)[::-1]])


def arrow_outline(
    vector: Float[np.ndarray, "2"], width_m: float, start: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "7 2"]:
    """Of an arrow from `start`; a short one is narrower, so that it keeps its look and vanishes at zero."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0 else np.zeros(2)
    across = np.array([-along[1], along[0]])
    head = min(3.2 * width_m, 0.6 * length)
    width = head / 3.2
    steps = [(0, 0.5), (length - head, 0.5), (length - head, 1.5), (length, 0.0)]
    side = [along * far + across * width * wide for far, wide in steps]
    other = [along * far - across * width * wide for far, wide in reversed(steps[:-1])]
    return np.asarray(start) + np.stack([*side, *other])
