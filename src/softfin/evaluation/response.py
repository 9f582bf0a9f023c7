"""How a controller answers a step of its reference: rise time, overshoot, settling, and the error of a moving one.

Forces and references at 100 Hz go in. Everything is of m, the moving average over 200 samples that controllers are
judged by: of a force that jumped at once it would still rise for 1.6 s and stand at the new reference after 2.0 s.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import WINDOW
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.window import moving_average, moving_error

SETTLED_N = 0.2
"""As near to the new reference counts as there, on both axes [N]."""

RISE = (0.1, 0.9)
"""Parts of the step between which the rise is timed."""

Force = Float[np.ndarray, "ticks 2"]


class Response(NamedTuple):
    """To one step of the reference, up to its next change or the end."""

    at_s: float
    """When the reference stepped."""
    start: Float[np.ndarray, "2"]
    """Reference before [N]."""
    to: Float[np.ndarray, "2"]
    """Reference after [N]."""
    rise_s: tuple[float | None, float | None]
    """Of each axis, from the first instant with 10% of the step done to the first with 90%; None of an axis that does
    not step, or never comes that far."""
    overshoot_percent: tuple[float | None, float | None]
    """Of each axis, how far m goes beyond the new reference, in parts of the step's size; None where none steps."""
    settling_s: float | None
    """Until m is within `SETTLED_N` of the new reference on both axes and stays there; None if it never does."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "at_s": self.at_s,
            "start_n": self.start.tolist(),
            "to_n": self.to.tolist(),
            **{f"rise_{axis}_s": self.rise_s[i] for i, axis in enumerate(AXES)},
            **{f"overshoot_{axis}_percent": self.overshoot_percent[i] for i, axis in enumerate(AXES)},
            "settling_s": self.settling_s,
        }


def tracking_error(force: Float[np.ndarray, "*batch ticks 2"], reference: Force) -> Float[np.ndarray, "*batch 2"]:
    """Mean |m(t) - r(t)| against the reference of that very instant, so the window's own delay counts too [N].

    `softfin.evaluation.scores.score` gives the other one, against the reference's mean over the window.
    """
    late = np.asarray(reference, np.float64)[WINDOW - 1 :]
    return np.asarray(moving_error(force, late))


def steps_of(reference: Force) -> list[tuple[int, int]]:
    """(first tick, one past the last) of each stretch behind a step: held for 2 s or more, as the one before it."""
    changes = np.flatnonzero((np.diff(reference, axis=0) != 0).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(reference)]
    held = [(start, stop) for start, stop in pairwise(edges) if stop - start >= WINDOW]
    starts = {stop for _, stop in held}
    return [(start, stop) for start, stop in held if start in starts]


def responses(force: Force, reference: Force) -> list[Response]:
    """To every step of a reference."""
    average = moving_average(force)
    return [_response(average, np.asarray(reference, np.float64), *stretch) for stretch in steps_of(reference)]


def _response(
    average: Float[np.ndarray, "windows 2"], reference: Float[np.ndarray, "ticks 2"], first: int, stop: int
) -> Response:
    start, to = reference[first - 1], reference[first]
    # Window k ends with tick k + WINDOW - 1, and the stretch before was long enough for one.
    after = average[first - WINDOW + 1 : stop - WINDOW + 1]
    moved = [axis for axis in range(2) if start[axis] != to[axis]]
    part = {axis: (after[:, axis] - start[axis]) / (to[axis] - start[axis]) for axis in moved}
    return Response(
        at_s=first / RATE_HZ,
        start=start,
        to=to,
        rise_s=_both({axis: _rise(values) for axis, values in part.items()}),
        overshoot_percent=_both({axis: 100 * max(float(values.max()) - 1, 0.0) for axis, values in part.items()}),
        settling_s=_settling(np.abs(after - to).max(axis=1)),
    )


def _both(values: dict[int, float | None]) -> tuple[float | None, float | None]:
    return values.get(0), values.get(1)


def _rise(part: Float[np.ndarray, " ticks"]) -> float | None:
    low, high = (np.flatnonzero(part >= level) for level in RISE)
    return (int(high[0]) - int(low[0])) / RATE_HZ if high.size else None


def _settling(distance: Float[np.ndarray, " ticks"]) -> float | None:
    outside = np.flatnonzero(distance > SETTLED_N)
    if not outside.size:
        return 0.0
    return (int(outside[-1]) + 2) / RATE_HZ if outside[-1] + 1 < len(distance) else None
