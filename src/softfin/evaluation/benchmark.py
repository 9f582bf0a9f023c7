"""The benchmark: a fixed protocol for any controller, in the virtual tank. Errors are those of the
true force."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float, Key

from softfin.control.controller import Controller, controller_clock
from softfin.control.references import (
    controller_cells,
    default_references,
    reachable_set,
    resolve_reference,
)
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, CoverageError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ, AnyArray
from softfin.core.randomness import named_key
from softfin.core.window import moving_average
from softfin.evaluation.experiment import (
    MIN_SECONDS,
    ExperimentRecording,
    independent,
    min_seconds,
    run_together,
)
from softfin.evaluation.frequency_response import ResponseRow, response
from softfin.evaluation.lock_step import choose_program
from softfin.evaluation.moving_references import MovingPlan
from softfin.evaluation.scores import mean_scores, score
from softfin.gaits.reachable import ForceVector
from softfin.tank.changing import ChangingTank
from softfin.tank.randomization import DomainRandomization, RandomizedTank, with_parameters
from softfin.tank.tank import Tank
from softfin.task.signals import Pulsing, Signal, Turning, step

PROTOCOL_VERSION = 1
"""Number of the default protocol; any change of its values or of a score increases it."""

STEPS = ((2, 3), (0, 2), (1, 5), (3, 0))
"""Start and end of the steps, as indices of the six references."""


TURN_DIRECTIONS = (1, -1)
"""Counterclockwise and clockwise."""

CHANGE_AFTER_S = (0, 4, 6, 10, 20, 30)
"""Times after the change of a fin at which windows end that are scored [s]; 0 is before it."""


class BenchmarkProtocol(Configuration):
    """The protocol of the benchmark. Results can be compared only if they have its default values
    and the same version."""

    references: tuple[tuple[pydantic.FiniteFloat, pydantic.FiniteFloat], ...] = ()
    """Six reference forces (x, y) [N]; by default those of softfin evaluate for this fin. Moving
    references turn about the centre of their bounding box with its smaller half side as radius."""
    seconds: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Duration of each experiment with constant references, steps (after half of it), a turn, and
    perturbed tanks [s]."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Number of seeds of the sensor."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed from which all others are derived."""
    widths: tuple[float, ...] = (0.15, 0.3)
    """Relative half-widths of the perturbed tanks [-]."""
    tanks: int = pydantic.Field(default=10, ge=1)
    """Number of tanks of each width."""
    change_s: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Time at which the fin changes, and duration after it [s]."""
    change_stiffness: pydantic.PositiveFloat = 0.75
    """Factor of the stiffness from then on [-]."""
    change_drag: pydantic.PositiveFloat = 0.9
    """Factor of the drag from then on [-]."""
    rates_hz: tuple[pydantic.PositiveFloat, ...] = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 0.9)
    """Rates at which the reference turns and pulses [Hz]. At multiples of 1 / window, the mean over
    the window shows no response."""
    rate_seconds: int = pydantic.Field(default=100, ge=1)
    """Duration over which the response is fitted, a multiple of all periods [s]."""
    rate_settle_s: int = pydantic.Field(default=10, ge=0)
    """Duration before it that is left out [s]."""
    rate_amplitude: pydantic.PositiveFloat = 0.5
    """Amplitude of the turning and pulsing references, relative to the radius of the turn [-]."""

    @pydantic.model_validator(mode="after")
    def _has_six_references(self) -> "BenchmarkProtocol":
        if len(self.references) not in (0, 6):
            raise ValueError(
                f"references: {len(self.references)}; use six, because steps connect them, or none "
                "for the default"
            )
        return self


class _Entry(NamedTuple):
    """A controller in a tank."""

    controller: Controller
    tank: Tank
    protocol: BenchmarkProtocol
    references: tuple[ForceVector, ...]
    tracked: Float[np.ndarray, "references 2"]
    """References, with unreachable ones replaced by the nearest reachable forces [N]."""
    centre_n: ForceVector
    """Centre of the references."""
    radius_n: float
    """Smaller half side of their bounding box."""

    def keys(self, name: str, count: int) -> Key[Array, "keys"]:
        seed = self.protocol.seed
        return jnp.stack([named_key(seed, f"{name}/{index}") for index in range(count)])

    def run(
        self, plant: Plant, experiments: list[tuple[AnyArray, int]], keys: Key[Array, "keys"]
    ) -> list[ExperimentRecording]:
        program = choose_program(self.controller)
        recordings = run_together(self.controller, plant, experiments, keys, program)
        return [independent(recording) for recording in recordings]

    def plan(self, name: str, signals: tuple[Signal, ...], seconds: int) -> MovingPlan:
        return MovingPlan.of(name, self.controller, signals, seconds)


def run_benchmark(
    controller: Controller, tank: Tank, protocol: BenchmarkProtocol, progress: Progress = silent
) -> JsonObject:
    """Run all cases; returns their scores by name, with the references and the warnings.

    A case whose references the controller does not cover has the entry ``not_covered`` instead of
    scores.

    Raises:
        CoverageError: If the controller was not trained for one of the six references.
        ConfigurationError: If the references are on a line, or the experiments are too short for
            the clock of the controller.
    """
    clock = controller_clock(controller)
    if protocol.seconds < min_seconds(clock):
        raise ConfigurationError(
            f"seconds = {protocol.seconds}: too short for the clock of this controller ({clock}); "
            f"use at least {min_seconds(clock)}"
        )
    references = protocol.references or default_references(
        reachable_set(controller), controller_cells(controller)
    )
    resolved = [resolve_reference(controller, force, strict=False) for force in references]
    low = np.min(references, axis=0)
    high = np.max(references, axis=0)
    radius_n = float((high - low).min() / 2)
    if radius_n == 0:
        raise ConfigurationError("references: all have the same x or y; use references that differ")
    x, y = ((low + high) / 2).tolist()
    tracked = np.array([force for force, _ in resolved], np.float32)
    entry = _Entry(controller, tank, protocol, references, tracked, (x, y), radius_n)
    cases: JsonObject = {}
    for index, (name, case) in enumerate(CASES.items()):
        progress("benchmark", index / len(CASES), name)
        try:
            cases[name] = case(entry)
        except CoverageError as error:
            cases[name] = {"not_covered": str(error)}
    progress("benchmark", 1.0, "")
    return {
        "references_n": references,
        "tracked_references_n": tracked,
        "centre_n": entry.centre_n,
        "radius_n": radius_n,
        "warnings": [warning for _, warning in resolved if warning is not None],
        "cases": cases,
    }


def _constant(entry: _Entry) -> JsonObject:
    """Run the six references."""
    protocol = entry.protocol
    keys = entry.keys("evaluate", protocol.seeds)
    recording = entry.run(entry.tank, [(entry.tracked, protocol.seconds)], keys)[0]
    scores = score(recording)
    rows = [
        {"reference_n": reference, **mean_scores(scores, index)}
        for index, reference in enumerate(entry.references)
    ]
    return {"mean": mean_scores(scores), "rows": rows}


def _moving(entry: _Entry) -> JsonObject:
    """Run four steps, and one turn in both directions. There are as many experiments as in
    `_constant`, so that both use the same compiled program."""
    protocol = entry.protocol
    seconds = protocol.seconds
    references = entry.references
    steps = tuple(step(references[i], references[j], seconds / 2) for i, j in STEPS)
    turns = tuple(Turning(entry.centre_n, entry.radius_n, way / seconds) for way in TURN_DIRECTIONS)
    plans = [entry.plan("steps", steps, seconds), entry.plan("turns", turns, seconds)]
    experiments: list[tuple[AnyArray, int]] = [(plan.tracked, seconds) for plan in plans]
    keys = entry.keys("evaluate", protocol.seeds)
    recordings = entry.run(entry.tank, experiments, keys)
    found: JsonObject = {"warnings": [warning for plan in plans for warning in plan.warnings]}
    for plan, recording in zip(plans, recordings, strict=True):
        scored = plan.score(recording)
        found[plan.name] = {"mean": mean_scores(scored.scores), "rows": scored.rows()}
    return found


def _perturbed(entry: _Entry) -> JsonObject:
    """Run the six references in perturbed tanks."""
    protocol = entry.protocol
    keys = entry.keys("benchmark/tank", protocol.tanks)
    rows = []
    for width in protocol.widths:
        plant = RandomizedTank(entry.tank, DomainRandomization.of(width))
        recording = entry.run(plant, [(entry.tracked, protocol.seconds)], keys)[0]
        scores = score(recording)
        worst_n = scores.error.mean(axis=0).max(axis=0)
        rows.append({"width": width, "worst_tank_n": worst_n, **mean_scores(scores)})
    return {"rows": rows}


def _changed(entry: _Entry) -> JsonObject:
    """Run the six references on a fin that changes at once."""
    protocol = entry.protocol
    start_s = protocol.change_s
    after = with_parameters(
        entry.tank, stiffness=protocol.change_stiffness, drag=protocol.change_drag
    )
    plant = ChangingTank.between(entry.tank, after, start_s, start_s)
    keys = entry.keys("evaluate", protocol.seeds)
    recording = entry.run(plant, [(entry.tracked, 2 * start_s)], keys)[0]
    window = recording.clock.window_ticks
    mean = moving_average(np.asarray(recording.force), window)
    error = mean - entry.tracked[:, None, None]
    rows = []
    for after_s in CHANGE_AFTER_S:
        if after_s <= start_s:
            at = error[:, :, (start_s + after_s) * RATE_HZ - window]
            rows.append({"after_s": after_s, "rms_n": np.sqrt((at**2).mean(axis=(0, 1)))})
    return {"rows": rows}


def _frequency(entry: _Entry) -> JsonObject:
    """Run references that turn and pulse at several rates."""
    protocol = entry.protocol
    amplitude_n = protocol.rate_amplitude * entry.radius_n
    seconds = protocol.rate_settle_s + protocol.rate_seconds
    centre = complex(*entry.centre_n)
    direction = centre / abs(centre) if centre else 1 + 0j
    along = (direction.real, direction.imag)
    turning = [Turning(entry.centre_n, amplitude_n, rate) for rate in protocol.rates_hz]
    pulsing = [Pulsing(entry.centre_n, along, amplitude_n, rate) for rate in protocol.rates_hz]
    plan = entry.plan("frequency", (*turning, *pulsing), seconds)
    recording = entry.run(entry.tank, [(plan.tracked, seconds)], entry.keys("evaluate", 1))[0]
    motions: dict[str, list[ResponseRow]] = {"turn": [], "pulse": []}
    for signal, force, tracked in zip(
        (*turning, *pulsing), np.asarray(recording.force)[:, 0], plan.tracked, strict=True
    ):
        turns = isinstance(signal, Turning)
        row = response(
            force,
            tracked,
            signal.rate_hz,
            recording.clock.window_ticks,
            protocol.rate_settle_s,
            None if turns else direction,
        )
        motions["turn" if turns else "pulse"].append(row)
    return {"amplitude_n": amplitude_n, "warnings": plan.warnings, **motions}


CASES: Mapping[str, Callable[[_Entry], JsonObject]] = MappingProxyType(
    {
        "references": _constant,
        "moving": _moving,
        "perturbed": _perturbed,
        "changed": _changed,
        "frequency": _frequency,
    }
)
"""The cases by name, in the order in which they run."""
