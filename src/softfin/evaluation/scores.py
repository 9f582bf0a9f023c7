"""The scores of Table II: how near the moving average of the force stays to its reference, and how steadily.

A Recording goes in; per reference, seed and axis come out, with m the moving average of the force f over the 200
samples up to each instant, where those 200 are all recorded, and r the reference:

    error = mean |m - r|        std = standard deviation of m        raw std = standard deviation of f

Of a reference that moves, r is its mean over the same 200 samples: the delay of the window is not the controller's.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import ACTION_TICKS, ticks_of
from softfin.core.quantities import RATE_HZ
from softfin.core.window import moving_average, moving_error
from softfin.evaluation.experiment import Recording

STILL_RAD_S = 0.1
"""A shaft that travels less than this in the second half of the experiment stands still; a fin that works does > 1."""


class Scores(NamedTuple):
    """Of each experiment, in float64."""

    error: Float[np.ndarray, "references seeds 2"]
    """[N], (x, y)"""
    std: Float[np.ndarray, "references seeds 2"]
    """[N], of the moving average"""
    raw_std: Float[np.ndarray, "references seeds 2"]
    """[N], of the force itself"""
    command_travel: Float[np.ndarray, "references seeds"]
    """[rad/s]: how far the target angle moves"""
    shaft_travel: Float[np.ndarray, "references seeds"]
    """[rad/s]: how far the shaft moves"""
    late_travel: Float[np.ndarray, "references seeds"]
    """[rad/s]: how far the shaft moves in the second half; below `STILL_RAD_S` it stands still"""


def score(recording: Recording) -> Scores:
    """Score every experiment of a recording, of at least one window."""
    force = np.asarray(recording.reading.force, np.float64)
    asked = np.asarray(recording.reference, np.float64)
    reference = (asked[:, None] if asked.ndim == 2 else moving_average(asked))[:, None]
    shaft = np.asarray(recording.reading.angle, np.float64)
    return Scores(
        error=moving_error(force, reference),
        std=moving_average(force).std(axis=2),
        raw_std=force.std(axis=2),
        command_travel=travel(np.asarray(recording.command.angle, np.float64)),
        shaft_travel=travel(shaft),
        late_travel=travel(shaft[..., shaft.shape[-1] // (2 * RATE_HZ) * RATE_HZ :]),
    )


def travel(angle: Float[np.ndarray, "*batch ticks"]) -> Float[np.ndarray, "*batch"]:
    """Path length a second [rad/s], from one action's end to the next, so that no sensor noise adds to it."""
    ends = np.cumsum(ticks_of(angle.shape[-1] // RATE_HZ * len(ACTION_TICKS))) - 1
    path = np.abs(np.diff(angle[..., ends], axis=-1)).sum(axis=-1)
    return np.asarray(path / ((ends[-1] - ends[0]) / RATE_HZ))
