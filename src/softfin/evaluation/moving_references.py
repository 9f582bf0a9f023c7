"""Experiments with moving references: steps within the range of a controller, or a recorded signal.

The results are recordings, tracking errors and the response to every step.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller, controller_clock
from softfin.control.references import nearest_trackable, reachable_set
from softfin.core.errors import CoverageError
from softfin.core.quantities import RATE_HZ
from softfin.evaluation.experiment import ExperimentRecording, independent, min_seconds
from softfin.evaluation.range_errors import controller_range
from softfin.evaluation.results import MovingRow
from softfin.evaluation.scores import Scores, mean_scores, score, settled_band, settling_times
from softfin.gaits.reachable import Cell, ForceVector, Reachable, force_decimals
from softfin.storage import artifact as artifacts
from softfin.task.signals import Recorded, ReferenceSamples, step

STEPS = (((3, 3), (5, 3)), ((1, 1), (3, 3)), ((3, 1), (3, 5)), ((5, 3), (1, 1)))
"""Start and end of the default steps, in sixths of the controller's range on each axis. For the
paper's range, the steps are (2, 0) to (3, 0), (1, -1) to (2, 0), (2, -1) to (2, 1) and (3, 0) to
(1, -1) N."""

STEP_SECONDS = 20
"""Duration of an experiment with a step, which occurs after half this time [s]."""


def default_steps(cell: Cell, reachable: Reachable | None = None) -> tuple[Recorded, ...]:
    """Return the default steps within a range; unreachable forces are replaced by the nearest
    reachable forces."""
    low = np.asarray(cell.low)
    high = np.asarray(cell.high)
    # Few enough digits to print, but enough for the force to stay reachable.
    decimals = force_decimals(float(np.abs([low, high]).max())) + 2

    def at(sixths: tuple[int, int]) -> ForceVector:
        force = low + np.asarray(sixths) / 6 * (high - low)
        if reachable is not None and not reachable.contains(force):
            force = reachable.nearest_within((cell,), force[None])[0]
        if not np.isfinite(force).all():
            raise CoverageError(
                f"moving references within {cell}: this fin can produce none of these forces; "
                "train the controller for reachable forces (run softfin map to plot them)"
            )
        x, y = force.round(decimals).tolist()
        return x, y

    return tuple(step(at(start), at(to), STEP_SECONDS / 2) for start, to in STEPS)


class MovingPlan(NamedTuple):
    """Signals of equal length and the forces to track."""

    name: str
    """Name of the figure."""
    signals: tuple[Recorded, ...]
    seconds: int
    tracked: Float[np.ndarray, "signals ticks 2"]
    """Tracked reference, one force per tick [N]: the signal, with unreachable forces replaced by
    the nearest reachable forces."""
    warnings: tuple[str, ...]
    """Warnings about unreachable forces."""
    settled_n: float
    """Distance from the reference within which the force is treated as settled [N]."""

    @classmethod
    def of(
        cls,
        name: str,
        controller: Controller,
        signals: tuple[Recorded, ...],
        seconds: int,
        strict: bool = False,
    ) -> "MovingPlan":
        """Find the forces to track; raises CoverageError if a force is outside the range of the
        controller or, with `strict`, unreachable."""
        tracked = []
        warnings = []
        for signal in signals:
            series, warning = _resolve_signal(controller, signal, seconds * RATE_HZ, strict)
            tracked.append(series)
            if warning is not None:
                warnings.append(warning)
        settled_n = settled_band(reachable_set(controller))
        return cls(name, signals, seconds, np.stack(tracked), tuple(warnings), settled_n)

    def score(self, recording: ExperimentRecording) -> "MovingScores":
        """Score each signal at every seed; errors are relative to the tracked reference."""
        recording = independent(recording)
        window = recording.clock.window_ticks
        settling = []
        for forces, tracked in zip(np.asarray(recording.force), self.tracked, strict=True):
            times = [settling_times(force, tracked, self.settled_n, window) for force in forces]
            settling.append(np.stack(times))
        return MovingScores(self, recording.first(), score(recording), settling)


class MovingScores(NamedTuple):
    """Results of experiments of equal length with moving references."""

    plan: MovingPlan
    recording: ExperimentRecording
    """Recording of the first seed: reference ``(signals, ticks, 2)``, other fields ``(signals, 1,
    ticks)``."""
    scores: Scores
    settling: list[Float[np.ndarray, "seeds steps"]]
    """Settling times of each signal [s]; NaN for never."""

    def rows(self) -> list[MovingRow]:
        """Return the scores of each signal for JSON."""
        rows: list[MovingRow] = []
        for index, (signal, times) in enumerate(zip(self.plan.signals, self.settling, strict=True)):
            settles = bool(np.isfinite(times).all()) if times.size else None
            rows.append(
                {
                    **mean_scores(self.scores, index),
                    "described": str(signal),
                    "duration_s": self.plan.seconds,
                    "settles": settles,
                    "longest_settling_s": float(times.max()) if settles else None,
                    "settling_s": artifacts.plain(times),
                }
            )
        return rows


def _resolve_signal(
    controller: Controller, signal: Recorded, ticks: int, strict: bool
) -> tuple[ReferenceSamples, str | None]:
    """Return the force to track at each tick (the nearest reachable force), and a warning if the
    forces differ from the signal."""
    references = signal.sample(ticks)
    # Search only once per distinct force: most ticks of a signal repeat a force, and the search for
    # the nearest reachable force is slow.
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
            f"{problem}; remove --strict to track the nearest reachable forces in the range of "
            "this controller instead"
        )
    return near, (
        f"{problem}; the nearest reachable forces in the range of this controller are tracked "
        "instead"
    )


def plan_moving(
    controller: Controller, steps: bool, recorded: Recorded | None, strict: bool = False
) -> Iterable[MovingPlan]:
    """Yield the plans of the default steps and of a recorded signal."""
    if steps:
        signals = default_steps(controller_range(controller), reachable_set(controller))
        yield MovingPlan.of("steps", controller, signals, STEP_SECONDS, strict)
    if recorded is not None:
        seconds = max(recorded.seconds, min_seconds(controller_clock(controller)))
        yield MovingPlan.of("recorded", controller, (recorded,), seconds, strict)
