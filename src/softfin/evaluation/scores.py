"""The scores of Table II and of responses to steps: a recording goes in, errors by reference, seed and axis come out.

With m the moving average of the force f over the 200 samples up to each instant, where those are all recorded, and r
the reference, which is averaged over the same samples where it moves (`softfin.core.window`):

    error = mean |m - r|        std = standard deviation of m        raw std = standard deviation of f

Responses are also of m: of a force that jumped at once it would rise for 1.6 s and settle after at most 2.0 s.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import ACTION_TICKS, WINDOW, ticks_of
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.window import moving_average, moving_error
from softfin.evaluation.experiment import ExperimentRecording

STILL_RAD_S = 0.1
"""A shaft that travels less than this in the second half of the experiment stands still; a working one does > 1."""

SETTLED_N = 0.2
"""Distance on both axes within which the force has settled at the reference [N]."""

Force = Float[np.ndarray, "ticks 2"]


class Scores(NamedTuple):
    """Scores of each experiment, in float64."""

    error: Float[np.ndarray, "references seeds 2"]
    """Mean |moving average - reference| (x, y) [N]."""
    std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the moving average [N]."""
    raw_std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the force itself [N]."""
    command_travel: Float[np.ndarray, "references seeds"]
    """Path of the target angle a second [rad/s]."""
    shaft_travel: Float[np.ndarray, "references seeds"]
    """Path of the shaft a second [rad/s]."""
    late_travel: Float[np.ndarray, "references seeds"]
    """Path of the shaft a second in the second half [rad/s]; below `STILL_RAD_S` it stands still."""


def score(recording: ExperimentRecording) -> Scores:
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


def instantaneous_error(force: Float[np.ndarray, "*batch ticks 2"], reference: Force) -> Float[np.ndarray, "*batch 2"]:
    """Mean |m(t) - r(t)| against the reference of that very instant, so the window's own delay counts too [N]."""
    late = np.asarray(reference, np.float64)[WINDOW - 1 :]
    return np.asarray(moving_error(force, late))


class StepResponse(NamedTuple):
    """Response of the moving average to one step of the reference, up to its next change or the end."""

    at_s: float
    """Time of the step [s]."""
    start: Float[np.ndarray, "2"]
    """Reference before the step [N]."""
    to: Float[np.ndarray, "2"]
    """Reference after the step [N]."""
    rise_s: tuple[float | None, float | None]
    """Time of each axis from 10% to 90% of the step [s]; None where it does not step or never comes that far."""
    overshoot_percent: tuple[float | None, float | None]
    """How far each axis goes beyond the new reference, in parts of the step; None where it does not step."""
    settling_s: float | None
    """Time until both axes are within `SETTLED_N` of the new reference and stay there [s]; None if they never do."""

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON."""
        return {
            "at_s": self.at_s,
            "start_n": self.start.tolist(),
            "to_n": self.to.tolist(),
            **{f"rise_{axis}_s": self.rise_s[i] for i, axis in enumerate(AXES)},
            **{f"overshoot_{axis}_percent": self.overshoot_percent[i] for i, axis in enumerate(AXES)},
            "settling_s": self.settling_s,
        }


def steps_of(reference: Force) -> list[tuple[int, int]]:
    """(first tick, one past the last) after each step between two forces that are both held for 2 s or more."""
    changes = np.flatnonzero((np.diff(reference, axis=0) != 0).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(reference)]
    held = [(start, stop) for start, stop in pairwise(edges) if stop - start >= WINDOW]
    starts = {stop for _, stop in held}
    return [(start, stop) for start, stop in held if start in starts]


def step_responses(force: Force, reference: Force) -> list[StepResponse]:
    """Responses to every step of a reference."""
    average, asked = moving_average(force), np.asarray(reference, np.float64)
    return [_response(average, asked, *ticks) for ticks in steps_of(reference)]


def _response(average: Float[np.ndarray, "windows 2"], reference: Force, first: int, stop: int) -> StepResponse:
    start, to = reference[first - 1], reference[first]
    # Window k ends with tick k + WINDOW - 1, and the force before was held long enough for one.
    after = average[first - WINDOW + 1 : stop - WINDOW + 1]
    rise: list[float | None] = [None, None]
    overshoot: list[float | None] = [None, None]
    for axis in np.flatnonzero(start != to).tolist():
        part = (after[:, axis] - start[axis]) / (to[axis] - start[axis])
        low, high = (np.flatnonzero(part >= level) for level in (0.1, 0.9))
        rise[axis] = (int(high[0]) - int(low[0])) / RATE_HZ if high.size else None
        overshoot[axis] = 100 * max(float(part.max()) - 1, 0.0)
    outside = np.flatnonzero(np.abs(after - to).max(axis=1) > SETTLED_N)
    settling: float | None = 0.0
    if outside.size:
        settling = (int(outside[-1]) + 2) / RATE_HZ if outside[-1] + 1 < len(after) else None
    return StepResponse(first / RATE_HZ, start, to, (rise[0], rise[1]), (overshoot[0], overshoot[1]), settling)
