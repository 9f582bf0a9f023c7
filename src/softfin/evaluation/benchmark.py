"""The benchmark: a fixed protocol for any controller, in the virtual tank. Errors are those of the
true force."""

import numpy as np
import pydantic
from jaxtyping import Array, Float, Key

from softfin.control.controller import Controller
from softfin.control.family import Family
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.core.configuration import Configuration
from softfin.core.errors import CoverageError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ
from softfin.core.window import moving_average
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.experiment import MIN_SECONDS, run
from softfin.evaluation.frequency_response import response
from softfin.evaluation.moving_references import MovingPlan
from softfin.gaits.reachable import Forces
from softfin.tank.changing import ChangingTank
from softfin.tank.randomization import DomainRandomization, RandomizedTank, with_parameters
from softfin.tank.tank import Tank
from softfin.task.signals import Recorded, step

PROTOCOL_VERSION = 1
"""Number of the default protocol; any change of its values or of a score increases it."""

STEP_ENDS = ((2, 3), (0, 2), (1, 5), (3, 0))
"""Start and end of the steps, as indices of the six references."""

Vector = Float[np.ndarray, "2"]
"""A force (x, y) [N]."""

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
        if self.references and not np.ptp(self.references, axis=0).all():
            raise ValueError("references: all have the same x or y; use references that differ")
        return self


def run_benchmark(
    controller: Controller,
    tank: Tank,
    protocol: BenchmarkProtocol,
    feedback: FeedbackConfig | None = None,
    family: Family | None = None,
    progress: Progress = silent,
) -> JsonObject:
    """Run all cases and return their scores by name.

    If the controller does not cover the references of a case, the case is ``{"not_covered":
    reason}``.

    Raises:
        CoverageError: If the controller was not trained for one of the six references.
        ConfigurationError: If the experiments are too short for the clock of the controller.
    """
    config = EvaluateConfig(
        references=protocol.references,
        seconds=protocol.seconds,
        seeds=protocol.seeds,
        seed=protocol.seed,
        feedback=feedback,
    )
    progress("benchmark", 0.0, "references")
    constant = score_controller(controller, tank, config, family)
    references = constant.config.references
    tracked = np.asarray(constant.recording.reference)
    cases: JsonObject = {"references": constant.summary()}

    progress("benchmark", 0.2, "perturbed tanks")
    in_tanks = config.model_copy(update={"seeds": protocol.tanks})
    cases["perturbed"] = []
    for width in protocol.widths:
        perturbed = RandomizedTank(tank, DomainRandomization.of(width))
        evaluation = score_controller(controller, perturbed, in_tanks, family)
        cases["perturbed"].append({"width": width, **evaluation.summary()})

    # The feedback is added only now, because `score_controller` adds it by itself.
    if feedback is not None:
        controller = Feedback(controller, feedback, family)
    keys = config.keys()
    progress("benchmark", 0.5, "a fin that changes")
    start_s = protocol.change_s
    after = with_parameters(tank, stiffness=protocol.change_stiffness, drag=protocol.change_drag)
    changing = ChangingTank.between(tank, after, start_s, start_s)
    recording = run(controller, changing, tracked, 2 * start_s, keys)
    window = recording.clock.window_ticks
    # (references, seeds, windows, 2)
    error = moving_average(np.asarray(recording.force), window) - tracked[:, None, None]
    cases["changed"] = [
        {
            "after_s": after_s,
            "rms_n": np.sqrt(
                (error[:, :, (start_s + after_s) * RATE_HZ - window] ** 2).mean(axis=(0, 1))
            ),
        }
        for after_s in CHANGE_AFTER_S
        if after_s <= start_s
    ]

    for share, name, case in ((0.7, "moving", _moving), (0.8, "frequency", _frequency)):
        progress("benchmark", share, name)
        try:
            cases[name] = case(controller, tank, protocol, np.array(references, float), keys)
        except CoverageError as error:
            cases[name] = {"not_covered": str(error)}
    progress("benchmark", 1.0, "")
    return cases


def _moving(
    controller: Controller,
    tank: Tank,
    protocol: BenchmarkProtocol,
    references: Forces,
    keys: Key[Array, "seeds"],
) -> JsonObject:
    """Run four steps, and one turn in both directions. There are as many experiments as constant
    references, so both use the same compiled program."""
    seconds = protocol.seconds
    centre, radius_n = _circle(references)
    x, y = radius_n * np.eye(2)
    steps = [step(tuple(references[i]), tuple(references[j]), seconds / 2) for i, j in STEP_ENDS]
    turns = [_orbit(centre, x, way * y, 1 / seconds, seconds) for way in (1, -1)]
    plan = MovingPlan.of("moving", controller, (*steps, *turns), seconds)
    rows = plan.score(run(controller, tank, plan.tracked, seconds, keys)).rows()
    for row, way in zip(rows[len(steps) :], ("counterclockwise", "clockwise"), strict=True):
        row["described"] = f"one turn, {way}"
    return {"rows": rows, "warnings": plan.warnings}


def _frequency(
    controller: Controller,
    tank: Tank,
    protocol: BenchmarkProtocol,
    references: Forces,
    keys: Key[Array, "seeds"],
) -> JsonObject:
    """Run references that turn and pulse at several rates, with the first seed."""
    centre, radius_n = _circle(references)
    x, y = protocol.rate_amplitude * radius_n * np.eye(2)
    # Along the centre, or along x if it is 0.
    direction = complex(*centre) / abs(complex(*centre)) if centre.any() else 1 + 0j
    along = direction.real * x + direction.imag * y
    seconds = protocol.rate_settle_s + protocol.rate_seconds
    rates_hz = protocol.rates_hz
    turns = [_orbit(centre, x, y, rate_hz, seconds) for rate_hz in rates_hz]
    pulses = [_orbit(centre, 0 * along, along, rate_hz, seconds) for rate_hz in rates_hz]
    plan = MovingPlan.of("frequency", controller, (*turns, *pulses), seconds)
    recording = run(controller, tank, plan.tracked, seconds, keys[:1])
    force = np.asarray(recording.force)[:, 0]
    rows = [
        response(
            force[index],
            plan.tracked[index],
            rate_hz,
            recording.clock.window_ticks,
            protocol.rate_settle_s,
            None if index < len(turns) else direction,
        )
        for index, rate_hz in enumerate((*rates_hz, *rates_hz))
    ]
    return {"turn": rows[: len(turns)], "pulse": rows[len(turns) :], "warnings": plan.warnings}


def _circle(references: Forces) -> tuple[Vector, float]:
    """Return the centre of the bounding box of forces, and its smaller half side [N]."""
    low = references.min(axis=0)
    high = references.max(axis=0)
    return (low + high) / 2, float((high - low).min() / 2)


def _orbit(centre: Vector, cosine: Vector, sine: Vector, rate_hz: float, seconds: int) -> Recorded:
    """Return the reference centre + cosine cos(2 pi f t) + sine sin(2 pi f t)."""
    time_s = np.arange(seconds * RATE_HZ) / RATE_HZ
    phase = 2 * np.pi * rate_hz * time_s[:, None]
    force = centre + np.cos(phase) * cosine + np.sin(phase) * sine
    return Recorded.build({"time_s": time_s.tolist(), "force_n": force.tolist()})
