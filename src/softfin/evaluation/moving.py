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
from softfin.control.references import reachable_of
from softfin.core.choices import MovingReference
from softfin.core.errors import CoverageError
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.statistics import interval
from softfin.evaluation.coverage import admitted_series, bounds
from softfin.evaluation.experiment import MIN_SECONDS, Recording, Subject, alike, check_finite, first_of, run
from softfin.evaluation.response import Response, responses, tracking_error
from softfin.evaluation.scores import score
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.signals import Force, Ramp, Recorded, Signal, Sinusoid, Step

At = Callable[[float, float], Force]
"""A place in a controller's range, each axis from 0 (its least reference) to 1 (its greatest)."""


def _steps(at: At) -> tuple[Signal, ...]:
    """Small and great, on one axis and on both."""
    low, middle, high = 1 / 6, 1 / 2, 5 / 6
    return (
        Step(start_n=at(middle, middle), to_n=at(high, middle)),
        Step(start_n=at(low, low), to_n=at(middle, middle)),
        Step(start_n=at(middle, low), to_n=at(middle, high)),
        Step(start_n=at(high, middle), to_n=at(low, low)),
    )


def _ramps(at: At) -> tuple[Signal, ...]:
    low, middle, high = 1 / 6, 1 / 2, 5 / 6
    return (
        Ramp(start_n=at(middle, low), to_n=at(middle, high)),
        Ramp(start_n=at(middle, middle), to_n=at(high, middle)),
    )


def _sines(at: At) -> tuple[Signal, ...]:
    """Up and down, then forwards and backwards."""

    def between(one: Force, other: Force) -> Sinusoid:
        (a, b), (c, d) = one, other
        return Sinusoid(centre_n=((a + c) / 2, (b + d) / 2), amplitude_n=((c - a) / 2, (d - b) / 2))

    low, middle, high = 1 / 6, 1 / 2, 5 / 6
    return between(at(middle, low), at(middle, high)), between(at(middle, middle), at(high, middle))


SIGNALS: Mapping[MovingReference, tuple[Callable[[At], tuple[Signal, ...]], int]] = MappingProxyType(
    {"step": (_steps, 20), "ramp": (_ramps, 20), "sine": (_sines, 30)}
)
"""Default signals by kind, with the length of their experiments [s]; in the paper's range:

======== ==============================================================================================================
``step`` at 10 s: (2, 0) to (3, 0), (1, -1) to (2, 0), (2, -1) to (2, 1), (3, 0) to (1, -1) N
``ramp`` from 5 s to 15 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
``sine`` of 10 s: (2, -1) to (2, 1), (2, 0) to (3, 0) N
======== ==============================================================================================================
"""


def signals_of(kind: MovingReference, cell: Cell, reachable: Reachable | None = None) -> tuple[Signal, ...]:
    """The default signals of a kind within a range; what the fin cannot make is brought to its reach."""
    (x0, y0), (x1, y1) = cell.low, cell.high

    def at(x: float, y: float) -> Force:
        place = (x0 + x * (x1 - x0), y0 + y * (y1 - y0))
        if reachable is not None and not reachable.contains(place):
            place = reachable.nearest_within((cell,), np.array([place]))[0].tolist()
        if not np.isfinite(place).all():
            raise CoverageError(
                f"references that move within {cell}: this fin can make none of these forces; train the controller "
                "within its reach (softfin map shows it)"
            )
        return round(place[0], 6), round(place[1], 6)

    return SIGNALS[kind][0](at)


@dataclasses.dataclass(frozen=True)
class Moving:
    """Experiments of one length, scored."""

    signals: tuple[Signal, ...]
    recording: Recording
    """Of the first seed alone: reference ``(signals, ticks, 2)``, other fields ``(signals, 1, ticks)``."""
    error: Float[np.ndarray, "signals seeds 2"]
    """Mean |moving average - the reference's mean over the same 200 samples| [N]."""
    instantaneous: Float[np.ndarray, "signals seeds 2"]
    """Mean |moving average - the reference at that instant| [N]."""
    responses: tuple[tuple[tuple[Response, ...], ...], ...]
    """Of each signal, of each seed, to each step."""
    replaced: tuple[int, ...] = ()
    """Of each signal, ticks at which another force was held than it asks for, as the fin cannot make that one."""

    def described(self) -> list[dict[str, Any]]:
        """One row a signal, for JSON."""
        return [self._row(i) for i in range(len(self.signals))]

    def settling(self, index: int) -> float | None:
        """The longest of a signal's steps and seeds [s]; infinite where one never settles; None without steps."""
        times = [step.settling_s for seed in self.responses[index] for step in seed]
        return max((np.inf if time is None else time for time in times), default=None)

    def _row(self, index: int) -> dict[str, Any]:
        signal = self.signals[index]
        kept = {"kind"} if not isinstance(signal, Recorded) else {"kind", "time_s", "force_n"}
        each, longest = self.responses[index], self.settling(index)
        return {
            "kind": signal.kind,
            "described": str(signal),
            "signal": signal.model_dump(mode="json", exclude=kept),
            "duration_s": self.recording.reading.angle.shape[-1] / RATE_HZ,
            "replaced_s": (self.replaced[index] if self.replaced else 0) / RATE_HZ,
            **{
                axis: {
                    "error_n": float(self.error[index, :, i].mean()),
                    "error_interval_n": interval(self.error[index, :, i]),
                    "instantaneous_error_n": float(self.instantaneous[index, :, i].mean()),
                }
                for i, axis in enumerate(AXES)
            },
            "settles": None if longest is None else bool(np.isfinite(longest)),
            "longest_settling_s": longest if longest is not None and np.isfinite(longest) else None,
            "steps": [[seed[k].described() for seed in each] for k in range(len(each[0]))],
        }


@dataclasses.dataclass(frozen=True)
class Plan:
    """Signals of one length."""

    signals: tuple[Signal, ...]
    seconds: int
    held: Float[np.ndarray, "signals ticks 2"] | None = None
    """What is held, one force a tick [N]: the signals, but for forces that the fin cannot make; None: the signals."""
    warnings: tuple[str, ...] = ()
    """Of such forces."""

    def sampled(self) -> Float[np.ndarray, "signals ticks 2"]:
        """What the signals ask for, one force a tick [N]."""
        return np.stack([signal.sample(self.seconds * RATE_HZ) for signal in self.signals])

    def admitted(self, controller: Controller, strict: bool) -> "Plan":
        """With what a controller can hold on its fin; raises CoverageError where a signal leaves its range."""
        pairs = [
            admitted_series(controller, asked, strict, str(signal))
            for signal, asked in zip(self.signals, self.sampled(), strict=True)
        ]
        held = np.stack([series for series, _ in pairs])
        return dataclasses.replace(self, held=held, warnings=tuple(said for _, said in pairs if said is not None))


def planned(
    controller: Controller, kinds: Iterable[MovingReference], recorded: Recorded | None, strict: bool = False
) -> list[Plan]:
    """The default signals of each kind, and a recorded one, as the fin can make them.

    Raises CoverageError where one leaves the controller's range, or with `strict` what the fin can make.
    """
    cell, reachable = bounds(controller), reachable_of(controller)
    plans = [Plan(signals_of(kind, cell, reachable), SIGNALS[kind][1]) for kind in dict.fromkeys(kinds)]
    if recorded is not None:
        plans.append(Plan((recorded,), max(recorded.seconds, MIN_SECONDS)))
    return [plan.admitted(controller, strict) for plan in plans]


def follow(controller: Controller, plant: Subject, plan: Plan, keys: Key[Array, "seeds"]) -> Moving:
    """Run and score the signals of a plan, each with every key; errors are against what is held."""
    wanted = plan.sampled()
    asked = wanted if plan.held is None else plan.held
    recording = run(controller, plant, asked, plan.seconds, keys)
    check_finite(recording)
    if alike(recording):
        recording = first_of(recording)
    force = np.asarray(recording.reading.force, np.float64)
    each = list(zip(force, asked, strict=True))
    return Moving(
        signals=plan.signals,
        recording=first_of(recording),
        error=score(recording).error,
        instantaneous=np.stack([tracking_error(seeds, reference) for seeds, reference in each]),
        responses=tuple(tuple(tuple(responses(seed, reference)) for seed in seeds) for seeds, reference in each),
        replaced=tuple(np.any(asked != wanted, axis=2).sum(axis=1).tolist()),
    )
