"""The scores of Table II and of responses to steps: a recording goes in, errors by reference, seed
and axis come out.

The force f is the true one if the plant knows it, as the virtual tank does. A controller with force
feedback must not be judged by the sensor's reading: feedback drives that reading to the reference,
so drift and mounting errors of the sensor would be invisible. A real rig has only the reading.

Let m be the moving average of f over the 200 samples up to each instant, if all are recorded, and r
the reference, averaged over the same samples if it moves (`softfin.core.window`):

    error = mean |m - r|
    std = standard deviation of m
    raw std = standard deviation of f

Responses are also those of m: for a force that jumps at once, m rises for 1.6 s and settles after
at most 2.0 s.

`score_uncertainty` tells how far scores in a surrogate can be trusted: an ensemble is run over the
recorded commands again, for its distance from its data and its intervals; other plants have
neither.
"""

from itertools import pairwise
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import ACTION_TICKS, WINDOW, action_ticks
from softfin.core.plant import EnsemblePlant, State
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, Command
from softfin.core.window import moving_average, moving_error
from softfin.evaluation.experiment import EvaluationTarget, ExperimentRecording
from softfin.evaluation.results import StepResponse, UncertaintyRow

STILL_RAD_S = 0.1
"""Speed below which a shaft counts as standing still in the second half of the experiment [rad/s];
a working one exceeds 1."""

SETTLED_N = 0.2
"""Distance from the reference on both axes within which the force counts as settled [N]."""

RARELY = 0.01
"""Fraction of samples outside the data up to which there is no warning: ten times that of the data
themselves."""

ForceSeries = Float[np.ndarray, "ticks 2"]


class Scores(NamedTuple):
    """Scores of each experiment, in float64."""

    error: Float[np.ndarray, "references seeds 2"]
    """Mean |moving average - reference| (x, y) [N] of the true force, or of the reading if there is
    only that."""
    std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the moving average [N]."""
    raw_std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the force itself [N]."""
    command_travel: Float[np.ndarray, "references seeds"]
    """Path of the target angle per second [rad/s]."""
    shaft_travel: Float[np.ndarray, "references seeds"]
    """Path of the shaft per second [rad/s]."""
    late_travel: Float[np.ndarray, "references seeds"]
    """Path of the shaft per second in the second half [rad/s]; below `STILL_RAD_S` it stands
    still."""
    reading_error: Float[np.ndarray, "references seeds 2"] | None
    """Error of the sensor's reading [N]; None if `error` already is that."""


def score(recording: ExperimentRecording) -> Scores:
    """Score every experiment of a recording with at least one window."""
    force = np.asarray(recording.force, np.float64)
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
        reading_error=None
        if recording.true_force is None
        else moving_error(np.asarray(recording.reading.force, np.float64), reference),
    )


def judged_force(recording: ExperimentRecording) -> str:
    """Return the name of the force by which `score` judges, for files and reports."""
    return "reading" if recording.true_force is None else "true force"


def travel(angle: Float[np.ndarray, "*batch ticks"]) -> Float[np.ndarray, "*batch"]:
    """Return the path length per second [rad/s], sampled at the ends of actions, so that sensor
    noise does not add to it."""
    ends = np.cumsum(action_ticks(angle.shape[-1] // RATE_HZ * len(ACTION_TICKS))) - 1
    path = np.abs(np.diff(angle[..., ends], axis=-1)).sum(axis=-1)
    return np.asarray(path / ((ends[-1] - ends[0]) / RATE_HZ))


def list_steps(reference: ForceSeries) -> list[tuple[int, int]]:
    """(first tick, one past the last) after each step between two forces that are both held for 2 s
    or more."""
    # A step is the boundary between two stretches that are each constant for a whole window: only
    # then does the moving average start and end at the references themselves.
    changes = np.flatnonzero((np.diff(reference, axis=0) != 0).any(axis=1)) + 1
    held = [
        (start, stop)
        for start, stop in pairwise([0, *changes.tolist(), len(reference)])
        if stop - start >= WINDOW
    ]
    starts = {stop for _, stop in held}
    return [(start, stop) for start, stop in held if start in starts]


def step_responses(force: ForceSeries, reference: ForceSeries) -> list[StepResponse]:
    """Responses of the moving average to every step of a reference, up to its next change or the
    end.

    ``rise_x_s`` is the time from 10% to 90% of the step [s], ``overshoot_x_percent`` how far the
    force exceeds the new reference as a percentage of the step, ``settling_s`` the time until both
    axes are within `SETTLED_N` of the new reference and stay there [s]; None if an axis does not
    step, or the force never gets there.
    """
    average = moving_average(force)
    asked = np.asarray(reference, np.float64)
    return [_response(average, asked, first, stop) for first, stop in list_steps(reference)]


def _response(
    average: Float[np.ndarray, "windows 2"], reference: ForceSeries, first: int, stop: int
) -> StepResponse:
    start = reference[first - 1]
    to = reference[first]
    # Window k ends with tick k + WINDOW - 1; the previous force was held long enough for one
    # window.
    after = average[first - WINDOW + 1 : stop - WINDOW + 1]
    rise_s: list[float | None] = [None, None]
    overshoot: list[float | None] = [None, None]
    for i in np.flatnonzero(start != to).tolist():
        # 0 at the reference before the step, 1 at the one after it, whichever way it goes.
        part = (after[:, i] - start[i]) / (to[i] - start[i])
        low, high = (np.flatnonzero(part >= level) for level in (0.1, 0.9))
        rise_s[i] = (int(high[0]) - int(low[0])) / RATE_HZ if high.size else None
        overshoot[i] = 100 * max(float(part.max()) - 1, 0.0)
    # Window k ends k + 1 ticks after the step; settled is the one after the last outside.
    outside = np.flatnonzero(np.abs(after - to).max(axis=1) > SETTLED_N)
    settled = 0 if not outside.size else int(outside[-1]) + 2
    return {
        "at_s": first / RATE_HZ,
        "start_n": start.tolist(),
        "to_n": to.tolist(),
        "rise_x_s": rise_s[0],
        "rise_y_s": rise_s[1],
        "overshoot_x_percent": overshoot[0],
        "overshoot_y_percent": overshoot[1],
        "settling_s": settled / RATE_HZ if settled <= len(after) else None,
    }


class SurrogateUncertainty(NamedTuple):
    """Uncertainty of a surrogate's forces, for each reference."""

    out_of_distribution_fraction: Float[np.ndarray, "references"]
    """Fraction of the samples at a distance above 1, which only 1 of 1000 training moments
    exceeds."""
    furthest: Float[np.ndarray, "references"]
    """Greatest distance."""
    half_width: Float[np.ndarray, "references 2"]
    """Half-width of the stated interval of the mean force, mean over the windows [N]."""

    def to_dict(self, index: int) -> UncertaintyRow:
        """Return the values of one reference, for JSON."""
        return {
            "out_of_distribution_fraction": float(self.out_of_distribution_fraction[index]),
            "furthest": float(self.furthest[index]),
            "half_width_x_n": float(self.half_width[index, 0]),
            "half_width_y_n": float(self.half_width[index, 1]),
        }

    def warning(self) -> str | None:
        """Return a sentence on how much is outside the data; None if hardly anything is."""
        fraction = self.out_of_distribution_fraction.mean()
        text = (
            f"{fraction:.1%} of the samples lie beyond what the surrogate was fitted to (distance "
            f"up to {self.furthest.max():.1f}, 1 is its edge): its forces there are extrapolated"
        )
        return text if fraction > RARELY else None


def score_uncertainty(
    plant: EvaluationTarget, recording: ExperimentRecording
) -> SurrogateUncertainty | None:
    """Return the uncertainty in the first repetition of every reference; None for a plant that
    estimates none."""
    if not isinstance(plant, EnsemblePlant):
        return None
    commands = Command(*(jnp.asarray(part[:, 0]) for part in recording.command))
    distance, force = (
        np.asarray(part)
        for part in _run_members(cast(EnsemblePlant, jit_argument(plant)), commands)
    )
    # (members, references, windows, 2): the interval is on the mean force over one window.
    means = np.stack([moving_average(member) for member in np.moveaxis(force, 2, 0)])
    half_width = np.asarray(plant.interval.half_width(means))
    return SurrogateUncertainty(
        (distance > 1).mean(axis=1), distance.max(axis=1), half_width.mean(axis=1)
    )


@eqx.filter_jit
def _run_members(plant: EnsemblePlant, commands: Command) -> tuple[Array, Array]:
    """Distances ``(references, ticks)`` and the members' forces ``(references, ticks, members,
    2)``."""

    def tick(state: State, command: Command) -> tuple[State, tuple[Array, Array]]:
        state, each = plant.advance_members(state, command, 1)
        return state, (plant.distance(state), jnp.asarray(each.force[:, 0]))

    start = plant.init(jax.random.key(0))
    return jax.vmap(lambda issued: jax.lax.scan(tick, start, issued)[1])(commands)
