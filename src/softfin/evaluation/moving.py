"""Experiments whose reference moves: steps, ramps, sines within a controller's range, or a recorded signal.

Controller, plant and signals go in; recordings, tracking errors and the responses to every step come out.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Key

from softfin.control.controller import Controller
from softfin.control.references import reachable_of, resolve_references, unreachable
from softfin.core.choices import MovingReference
from softfin.core.errors import CoverageError
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.window import interval
from softfin.evaluation.experiment import MIN_SECONDS, EvaluationTarget, ExperimentRecording, independent, run
from softfin.evaluation.range_errors import range_of
from softfin.evaluation.scores import StepResponse, instantaneous_error, score, step_responses
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.signals import Force, Ramp, Recorded, Signal, Sinusoid, Step

LOW, MIDDLE, HIGH = 1 / 6, 1 / 2, 5 / 6
"""Places in a controller's range, which goes from 0 (its least reference) to 1 (its greatest) on each axis."""

UP_AND_FORWARDS = (((MIDDLE, LOW), (MIDDLE, HIGH)), ((MIDDLE, MIDDLE), (HIGH, MIDDLE)))

STEPS = (
    ((MIDDLE, MIDDLE), (HIGH, MIDDLE)), ((LOW, LOW), (MIDDLE, MIDDLE)),
    ((MIDDLE, LOW), (MIDDLE, HIGH)), ((HIGH, MIDDLE), (LOW, LOW)),
)  # fmt: skip
"""Small and large steps, on one axis and on both."""


def _sine(start_n: Force, to_n: Force) -> Sinusoid:
    (a, b), (c, d) = start_n, to_n
    return Sinusoid(centre_n=((a + c) / 2, (b + d) / 2), amplitude_n=((c - a) / 2, (d - b) / 2))


SIGNALS: Mapping[MovingReference, tuple[Callable[..., Signal], tuple[Any, ...], int]] = MappingProxyType(
    {"step": (Step, STEPS, 20), "ramp": (Ramp, UP_AND_FORWARDS, 20), "sine": (_sine, UP_AND_FORWARDS, 30)}
)
"""Default signals by kind: from where to where in the range, and length of the experiment [s]; in the paper's range:

======== ==============================================================================================================
``step`` at 10 s: (2, 0) to (3, 0), (1, -1) to (2, 0), (2, -1) to (2, 1), (3, 0) to (1, -1) N
``ramp`` from 5 s to 15 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
``sine`` of 10 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
======== ==============================================================================================================
"""


def signals_of(kind: MovingReference, cell: Cell, reachable: Reachable | None = None) -> tuple[Signal, ...]:
    """The default signals of a kind within a range; forces that the fin cannot make are moved to its reach."""
    (x0, y0), (x1, y1) = cell.low, cell.high

    def at(x: float, y: float) -> Force:
        force = (x0 + x * (x1 - x0), y0 + y * (y1 - y0))
        if reachable is not None and not reachable.contains(force):
            force = reachable.nearest_within((cell,), np.array([force]))[0].tolist()
        if not np.isfinite(force).all():
            raise CoverageError(
                f"references that move within {cell}: this fin can make none of these forces; train the controller "
                "within its reach (softfin map shows it)"
            )
        return round(force[0], 6), round(force[1], 6)

    make, places, _ = SIGNALS[kind]
    return tuple(make(start_n=at(*start), to_n=at(*to)) for start, to in places)


@dataclasses.dataclass(frozen=True)
class MovingPlan:
    """Signals of one length, with the forces that are tracked."""

    signals: tuple[Signal, ...]
    seconds: int
    tracked: Float[np.ndarray, "signals ticks 2"]
    """Tracked reference, one force a tick [N]: the signals, but for forces that the fin cannot make."""
    warnings: tuple[str, ...] = ()
    """Sentences on forces that the fin cannot make."""

    @classmethod
    def of(
        cls, controller: Controller, signals: tuple[Signal, ...], seconds: int, strict: bool = False
    ) -> "MovingPlan":
        """Find the forces to track; raises CoverageError where a signal leaves the controller's range.

        With `strict` it is also raised for the first force that the fin cannot make.
        """
        pairs = [_resolve_signal(controller, signal, seconds * RATE_HZ, strict) for signal in signals]
        warnings = tuple(warning for _, warning in pairs if warning is not None)
        return cls(signals, seconds, np.stack([series for series, _ in pairs]), warnings)

    def run(self, controller: Controller, plant: EvaluationTarget, keys: Key[Array, "seeds"]) -> "MovingScores":
        """Run and score the signals, each with every key; errors are against the tracked reference."""
        recording = independent(run(controller, plant, self.tracked, self.seconds, keys))
        force = np.asarray(recording.reading.force, np.float64)
        each = list(zip(force, self.tracked, strict=True))
        asked = np.stack([signal.sample(self.seconds * RATE_HZ) for signal in self.signals])
        return MovingScores(
            signals=self.signals,
            recording=recording.first(),
            error=score(recording).error,
            instantaneous=np.stack([instantaneous_error(seeds, reference) for seeds, reference in each]),
            responses=tuple(tuple(tuple(step_responses(seed, asked)) for seed in seeds) for seeds, asked in each),
            replaced=tuple(np.any(self.tracked != asked, axis=2).sum(axis=1).tolist()),
        )


def _resolve_signal(
    controller: Controller, signal: Signal, ticks: int, strict: bool
) -> tuple[Float[np.ndarray, "ticks 2"], str | None]:
    """The force to track at each tick, the nearest that the fin can make, and a warning where it is not the signal."""
    references = signal.sample(ticks)
    distinct, places = np.unique(references, axis=0, return_inverse=True)
    near = resolve_references(controller, distinct).astype(np.float32)[places.reshape(-1)]
    distance = np.hypot(*(near - references).T)
    if not distance.any():
        return references, None
    first = int(np.argmax(distance > 0))
    if strict:
        (x, y), (a, b) = references[first].tolist(), near[first].tolist()
        raise CoverageError(
            f"{signal}, at {first / RATE_HZ:g} s: {unreachable((x, y), (a, b))}; ask for that, or leave out --strict"
        )
    return near, (
        f"{signal}: this fin cannot make what is asked in {np.count_nonzero(distance) / RATE_HZ:g} of "
        f"{len(references) / RATE_HZ:g} s, from {first / RATE_HZ:g} s on, by up to {distance.max():.3f} N; the nearest "
        "forces that it can make in this controller's range are held instead"
    )


def plan_moving(
    controller: Controller, kinds: Iterable[MovingReference], recorded: Recorded | None, strict: bool = False
) -> list[MovingPlan]:
    """The default signals of each kind, and a recorded one, as `MovingPlan.of` finds them."""
    cell, reachable = range_of(controller), reachable_of(controller)
    groups = [(signals_of(kind, cell, reachable), SIGNALS[kind][2]) for kind in dict.fromkeys(kinds)]
    if recorded is not None:
        groups.append(((recorded,), max(recorded.seconds, MIN_SECONDS)))
    return [MovingPlan.of(controller, signals, seconds, strict) for signals, seconds in groups]


@dataclasses.dataclass(frozen=True)
class MovingScores:
    """Scores of experiments of one length whose references move."""

    signals: tuple[Signal, ...]
    recording: ExperimentRecording
    """Recording of the first seed: reference ``(signals, ticks, 2)``, other fields ``(signals, 1, ticks)``."""
    error: Float[np.ndarray, "signals seeds 2"]
    """Mean |moving average - the reference's mean over the same 200 samples| [N]."""
    instantaneous: Float[np.ndarray, "signals seeds 2"]
    """Mean |moving average - the reference at that instant| [N]."""
    responses: tuple[tuple[tuple[StepResponse, ...], ...], ...]
    """Responses by signal, seed and step."""
    replaced: tuple[int, ...]
    """Ticks of each signal at which another force is tracked, because the fin cannot make the one asked for."""

    def settling(self, index: int) -> float | None:
        """Longest settling time over a signal's steps and seeds [s]; inf if one never settles; None without steps."""
        times = [step.settling_s for seed in self.responses[index] for step in seed]
        return max((np.inf if time is None else time for time in times), default=None)

    def to_dict(self) -> list[dict[str, Any]]:
        """One row a signal, for JSON."""
        rows = []
        for i, signal in enumerate(self.signals):
            axes = {
                axis: {
                    "error_n": float(self.error[i, :, k].mean()),
                    "error_interval_n": interval(self.error[i, :, k]),
                    "instantaneous_error_n": float(self.instantaneous[i, :, k].mean()),
                }
                for k, axis in enumerate(AXES)
            }
            each, longest = self.responses[i], self.settling(i)
            settles = None if longest is None else bool(np.isfinite(longest))
            # The rows of a recorded signal may be many; they stand in its file.
            left_out = {"kind", "time_s", "force_n"} if isinstance(signal, Recorded) else {"kind"}
            rows.append({
                "kind": signal.kind,
                "described": str(signal),
                "signal": signal.model_dump(mode="json", exclude=left_out),
                "duration_s": self.recording.reading.angle.shape[-1] / RATE_HZ,
                "replaced_s": self.replaced[i] / RATE_HZ,
                **axes,
                "settles": settles,
                "longest_settling_s": longest if settles else None,
                "steps": [[seed[k].to_dict() for seed in each] for k in range(len(each[0]))],
            })  # fmt: skip
        return rows
