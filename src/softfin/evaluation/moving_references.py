"""Experiments with moving references: steps, ramps and sines within a controller's range, or a
recorded signal.

The results are recordings, tracking errors and the response to every step.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from typing import NamedTuple, TypeAlias, cast

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller, controller_clock
from softfin.control.references import nearest_trackable, reachable_set
from softfin.core.choices import MovingReference
from softfin.core.errors import CoverageError
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.window import moving_error
from softfin.evaluation.experiment import ExperimentRecording, independent, min_seconds
from softfin.evaluation.range_errors import controller_range
from softfin.evaluation.results import MovingRow, StepResponse, TrackingErrors, score_keys
from softfin.evaluation.scores import SETTLED_N, score, settled_band, step_responses
from softfin.gaits.reachable import Cell, Reachable, force_decimals
from softfin.task.signals import (
    Ramp,
    Recorded,
    ReferenceForce,
    ReferenceSamples,
    Signal,
    Sinusoid,
    Step,
)

FORWARDS = ((3, 3), (5, 3))
UP = ((3, 1), (3, 5))
"""Start and end of a signal within a controller's range, in sixths of the range on each axis."""


def _sine(start_n: ReferenceForce, to_n: ReferenceForce) -> Sinusoid:
    (a, b) = start_n
    (c, d) = to_n
    return Sinusoid(centre_n=((a + c) / 2, (b + d) / 2), amplitude_n=((c - a) / 2, (d - b) / 2))


Sixths: TypeAlias = tuple[int, int]

SIGNALS: dict[
    MovingReference, tuple[Callable[..., Signal], tuple[tuple[Sixths, Sixths], ...], int]
] = {
    "step": (Step, (FORWARDS, ((1, 1), (3, 3)), UP, ((5, 3), (1, 1))), 20),
    "ramp": (Ramp, (UP, FORWARDS), 20),
    "sine": (_sine, (UP, FORWARDS), 30),
}
"""Default signals by kind: constructor, start and end within the range, and duration [s].

Within the paper's range:

- ``step`` at 10 s: (2, 0) to (3, 0), (1, -1) to (2, 0), (2, -1) to (2, 1), (3, 0) to (1, -1) N
- ``ramp`` from 5 s to 15 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
- ``sine`` of 10 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
"""


def moving_signals(
    kind: MovingReference, cell: Cell, reachable: Reachable | None = None
) -> tuple[Signal, ...]:
    """Return the default signals of a kind within a range; unreachable forces are replaced by the
    nearest reachable ones."""
    (x0, y0) = cell.low
    (x1, y1) = cell.high
    # Short enough to print, and exact enough to stay reachable.
    decimals = force_decimals(max(map(abs, (x0, y0, x1, y1)))) + 2

    def at(x: int, y: int) -> ReferenceForce:
        force = (x0 + x / 6 * (x1 - x0), y0 + y / 6 * (y1 - y0))
        if reachable is not None and not reachable.contains(force):
            force = reachable.nearest_within((cell,), np.array([force]))[0].tolist()
        if not np.isfinite(force).all():
            raise CoverageError(
                f"moving references within {cell}: this fin can produce none of these forces; "
                "train the controller for reachable forces (run softfin map to plot them)"
            )
        return round(force[0], decimals), round(force[1], decimals)

    make, places, _ = SIGNALS[kind]
    return tuple(make(start_n=at(*start), to_n=at(*to)) for start, to in places)


class MovingScores(NamedTuple):
    """Results of experiments of equal length with moving references."""

    recording: ExperimentRecording
    """Recording of the first seed: reference ``(signals, ticks, 2)``, other fields ``(signals, 1,
    ticks)``."""
    rows: list[MovingRow]
    """Scores of each signal."""
    settled_n: float = SETTLED_N
    """Distance from the reference within which the force counts as settled [N]."""


class MovingPlan(NamedTuple):
    """Signals of equal length, with the forces to track."""

    signals: tuple[Signal, ...]
    seconds: int
    tracked: Float[np.ndarray, "signals ticks 2"]
    """Tracked reference, one force per tick [N]: the signal, with unreachable forces replaced by
    the nearest reachable ones."""
    warnings: tuple[str, ...] = ()
    """Warnings about unreachable forces."""
    settled_n: float = SETTLED_N
    """Distance from the reference within which the force counts as settled [N]."""

    @classmethod
    def of(
        cls, controller: Controller, signals: tuple[Signal, ...], seconds: int, strict: bool = False
    ) -> "MovingPlan":
        """Find the forces to track; raises CoverageError for forces outside the controller's range,
        and with `strict` also for unreachable forces."""
        tracked = []
        warnings = []
        for signal in signals:
            series, warning = _resolve_signal(controller, signal, seconds * RATE_HZ, strict)
            tracked.append(series)
            if warning is not None:
                warnings.append(warning)
        settled_n = settled_band(reachable_set(controller))
        return cls(signals, seconds, np.stack(tracked), tuple(warnings), settled_n)

    def score(self, recording: ExperimentRecording) -> MovingScores:
        """Score each signal at every seed; errors are relative to the tracked reference."""
        recording = independent(recording)
        forces = np.asarray(recording.force, np.float64)
        scores = score(recording)
        window = recording.clock.window_ticks
        rows = []
        for index, (signal, tracked) in enumerate(zip(self.signals, self.tracked, strict=True)):
            reading_error = None if scores.reading_error is None else scores.reading_error[index]
            responses = [
                step_responses(force, tracked, self.settled_n, window) for force in forces[index]
            ]
            error = scores.error[index]
            rows.append(
                _row(signal, tracked, forces[index], responses, error, reading_error, window)
            )
        return MovingScores(recording.first(), rows, self.settled_n)


def _row(
    signal: Signal,
    tracked: ReferenceSamples,
    forces: np.ndarray,
    responses: list[list[StepResponse]],
    error: Float[np.ndarray, "seeds 2"],
    reading_error: Float[np.ndarray, "seeds 2"] | None,
    window: int,
) -> MovingRow:
    # Relative to the reference at the end of each window, so the window's delay counts as error.
    instantaneous = moving_error(forces, np.asarray(tracked, np.float64)[window - 1 :], window)
    errors = []
    for axis in range(len(AXES)):
        reading = None if reading_error is None else reading_error[:, axis]
        errors.append(_errors(error[:, axis], float(instantaneous[:, axis].mean()), reading))
    x, y = errors
    times = [step["settling_s"] for step in chain(*responses)]
    settled = [time for time in times if time is not None]
    # Without any step there is nothing to settle.
    settles = len(settled) == len(times) if times else None
    # The rows of a recorded signal are left out, because there may be many; they are in its file.
    left_out = {"kind", "time_s", "force_n"} if isinstance(signal, Recorded) else {"kind"}
    return {
        "kind": signal.kind,
        "described": str(signal),
        "signal": signal.model_dump(mode="json", exclude=left_out),
        "duration_s": len(tracked) / RATE_HZ,
        "replaced_s": int(np.any(tracked != signal.sample(len(tracked)), axis=1).sum()) / RATE_HZ,
        "x": x,
        "y": y,
        "settles": settles,
        "longest_settling_s": max(settled) if settles else None,
        "steps": list(map(list, zip(*responses, strict=True))),
    }


def moving_together(each: Sequence[MovingScores]) -> MovingScores:
    """Combine scores of the same signals at one seed each; the recording is the first one."""
    # Regroup the rows by signal; each group has one row per seed.
    by_signal = zip(*(scores.rows for scores in each), strict=True)
    rows = list(map(_row_together, by_signal))
    return MovingScores(each[0].recording, rows, each[0].settled_n)


def _row_together(rows: Sequence[MovingRow]) -> MovingRow:
    settles = None if rows[0]["settles"] is None else all(row["settles"] for row in rows)
    times = [time for row in rows if (time := row["longest_settling_s"]) is not None]
    # Regroup the responses by step, over all seeds.
    by_step = zip(*(row["steps"] for row in rows), strict=True)
    steps = [list(chain(*responses)) for responses in by_step]
    return {
        **rows[0],
        "x": _errors_together([row["x"] for row in rows]),
        "y": _errors_together([row["y"] for row in rows]),
        "settles": settles,
        "longest_settling_s": max(times) if settles else None,
        "steps": steps,
    }


def _errors_together(rows: Sequence[TrackingErrors]) -> TrackingErrors:
    reading_error = None
    if "reading_error_seeds_n" in rows[0]:
        reading_error = np.concatenate([row["reading_error_seeds_n"] for row in rows])
    return _errors(
        np.concatenate([row["error_seeds_n"] for row in rows]),
        float(np.mean([row["instantaneous_error_n"] for row in rows])),
        reading_error,
    )


def _errors(
    error: Float[np.ndarray, " seeds"],
    instantaneous_error: float,
    reading_error: Float[np.ndarray, " seeds"] | None,
) -> TrackingErrors:
    row = score_keys("error", error) | {"instantaneous_error_n": instantaneous_error}
    return cast(TrackingErrors, row | score_keys("reading_error", reading_error))


def _resolve_signal(
    controller: Controller, signal: Signal, ticks: int, strict: bool
) -> tuple[ReferenceSamples, str | None]:
    """Return the force to track at each tick (the nearest reachable force), and a warning if it
    differs from the signal."""
    references = signal.sample(ticks)
    # Most ticks of a signal repeat a force, and the search for the nearest reachable one is slow.
    distinct, places = np.unique(references, axis=0, return_inverse=True)
    near = nearest_trackable(controller, distinct).astype(np.float32)[places.reshape(-1)]
    distance = np.hypot(*(near - references).T)
    if not distance.any():
        return references, None
    decimals = force_decimals(float(np.abs(references).max())) + 1
    problem = (
        f"{signal}: this fin cannot produce the target force during "
        f"{np.count_nonzero(distance) / RATE_HZ:g} of {len(references) / RATE_HZ:g} s, starting at "
        f"{np.argmax(distance > 0) / RATE_HZ:g} s, and misses it by up to "
        f"{distance.max():.{decimals}f} N"
    )
    if strict:
        raise CoverageError(
            f"{problem}; remove --strict to track the nearest reachable forces in this "
            "controller's range instead"
        )
    return near, (
        f"{problem}; the nearest reachable forces in this controller's range are tracked instead"
    )


def plan_moving(
    controller: Controller,
    kinds: Iterable[MovingReference],
    recorded: Recorded | None,
    strict: bool = False,
) -> list[MovingPlan]:
    """Plan the default signals of each kind and an optional recorded signal."""
    cell = controller_range(controller)
    reachable = reachable_set(controller)
    groups = [
        (moving_signals(kind, cell, reachable), SIGNALS[kind][2]) for kind in dict.fromkeys(kinds)
    ]
    if recorded is not None:
        shortest = min_seconds(controller_clock(controller))
        groups.append(((recorded,), max(recorded.seconds, shortest)))
    return [MovingPlan.of(controller, signals, seconds, strict) for signals, seconds in groups]
