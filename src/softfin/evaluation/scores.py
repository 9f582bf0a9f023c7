"""Computes the scores of Table II and of step responses from a recording.

The force f is the true force if the plant computes it, as the virtual tank does. A controller with
force feedback must not be scored by the sensor reading: feedback drives the reading to the
reference, so sensor drift and mounting errors would be invisible. For a real rig, only the reading
is available.

Let m be the moving average of f over the last 200 samples, if all of them are recorded, and let r
be the reference, averaged over the same samples if it moves (`softfin.core.window`):

    error = mean |m - r|
    std = standard deviation of m
    raw std = standard deviation of f

Settling times are computed from m. After a force that jumps instantly, m settles within 2.0 s.

`data_distance` indicates whether scores in a surrogate can be trusted: it reruns an ensemble on the
recorded commands and returns the distance from the training data.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.json_object import JsonObject
from softfin.core.plant import EnsemblePlant, State
from softfin.core.power import mean_powers
from softfin.core.quantities import AXES, RATE_HZ, Command
from softfin.core.window import PAPER_WINDOW, interval, moving_average, moving_error
from softfin.evaluation.experiment import EvaluationTarget, ExperimentRecording
from softfin.evaluation.results import AxisScores, FeedbackScores, MeanScores
from softfin.gaits.reachable import Reachable

STILL_RAD_S = 0.1
"""Shaft travel in the second half of an experiment below which the fin is treated as at rest
[rad/s]; a working controller exceeds 1."""

SETTLED_N = 0.2
"""Distance from the reference, on both axes, within which the force of the paper's fin is settled
[N]; for other fins, it is multiplied by the fin size."""


def settled_band(reachable: Reachable | None) -> float:
    """Return the distance from the reference, on both axes, within which a force is settled [N]."""
    return SETTLED_N * (1.0 if reachable is None else reachable.size)


MAX_OUTSIDE_FRACTION = 0.01
"""Fraction of samples outside the training data above which a warning is issued: ten times the
fraction for the training data themselves."""

ForceSeries = Float[np.ndarray, "ticks 2"]


class Scores(NamedTuple):
    """Scores of each experiment in float64."""

    error: Float[np.ndarray, "references seeds 2"]
    """Mean |moving average - reference| (x, y) [N] of the true force, or of the reading if the true
    force is unknown."""
    std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the moving average [N]."""
    raw_std: Float[np.ndarray, "references seeds 2"]
    """Standard deviation of the force itself [N]."""
    shaft_travel: Float[np.ndarray, "references seeds"]
    """Path length of the shaft per second [rad/s]."""
    late_travel: Float[np.ndarray, "references seeds"]
    """Path length of the shaft per second in the second half [rad/s]; below `STILL_RAD_S`, the fin
    is treated as at rest."""
    reading_error: Float[np.ndarray, "references seeds 2"] | None
    """Error computed from the reading [N]; None if `error` is already computed from the reading."""
    thrust: Float[np.ndarray, "references seeds"]
    """Magnitude of the mean force [N]."""
    power: Float[np.ndarray, "references seeds 2"] | None
    """Mean mechanical and electrical power [W], NaN if not measured; None without both."""


def score(recording: ExperimentRecording) -> Scores:
    """Score every experiment in a recording, which must contain at least one window."""
    clock = recording.clock
    window = clock.window_ticks
    force = np.asarray(recording.force, np.float64)
    asked = np.asarray(recording.reference, np.float64)
    # (references, 1, 1, 2), or (references, 1, windows, 2) for moving references; broadcast over
    # the seeds.
    reference = (asked[:, None] if asked.ndim == 2 else moving_average(asked, window))[:, None]
    shaft = np.asarray(recording.reading.angle, np.float64)
    # The second half starts with a cycle of the action clock.
    cycle = sum(clock.ticks)
    second_half = shaft[..., shaft.shape[-1] // (2 * cycle) * cycle :]
    reading_error = None
    if recording.true_force is not None:
        reading_error = moving_error(
            np.asarray(recording.reading.force, np.float64), reference, window
        )
    return Scores(
        error=moving_error(force, reference, window),
        std=moving_average(force, window).std(axis=2),
        raw_std=force.std(axis=2),
        shaft_travel=travel(shaft, clock),
        late_travel=travel(second_half, clock),
        reading_error=reading_error,
        thrust=np.linalg.norm(force.mean(axis=2), axis=-1),
        power=None if recording.power is None else _mean_power(np.asarray(recording.power)),
    )


def _mean_power(
    power: Float[np.ndarray, "references seeds ticks 2"],
) -> Float[np.ndarray, "references seeds 2"]:
    """Return the means over the known values; NaN if fewer than half are known."""
    known = np.isfinite(power)
    count = known.sum(axis=2)
    means = np.where(known, power, 0.0).sum(axis=2) / np.maximum(count, 1)
    return np.where(2 * count >= power.shape[2], means, math.nan)


def mean_scores(scores: Scores, index: int | None = None) -> MeanScores:
    """Return the scores of one reference, or their means over all references, for JSON."""
    chosen: Scores = jax.tree.map(
        lambda field: field.mean(axis=0) if index is None else field[index], scores
    )
    axes = []
    for axis in range(len(AXES)):
        own_scores: JsonObject = {}
        for name in ("error", "std", "raw_std", "reading_error"):
            values = getattr(chosen, name)
            if values is not None:
                own = values[:, axis]
                own_scores[f"{name}_n"] = float(own.mean())
                own_scores[f"{name}_interval_n"] = interval(own)
                own_scores[f"{name}_seeds_n"] = own.tolist()
        axes.append(cast(AxisScores, own_scores))
    x, y = axes
    row: MeanScores = {
        "x": x,
        "y": y,
        "shaft_travel_rad_s": float(chosen.shaft_travel.mean()),
    }
    if chosen.power is not None:
        row["power"] = mean_powers(float(chosen.thrust.mean()), chosen.power.mean(axis=0).tolist())
    return row


def scores_together(each: Sequence[Scores]) -> Scores:
    """Combine scores for the same references. Each becomes one repetition, averaged over its own
    repetitions, so that all have equal weight."""
    together: Scores = jax.tree.map(
        lambda *fields: np.stack([field.mean(axis=1) for field in fields], axis=1), *each
    )
    return together


def judged_force(recording: ExperimentRecording) -> str:
    """Return the name of the force that `score` uses, for files and reports."""
    return "reading" if recording.true_force is None else "true force"


def travel(
    angle: Float[np.ndarray, "*batch ticks"], clock: ActionClock = PAPER_CLOCK
) -> Float[np.ndarray, "*batch"]:
    """Return the path length per second [rad/s].

    The angle is sampled only at the ends of actions, so that sensor noise does not accumulate.
    """
    ticks = angle.shape[-1]
    ends = np.cumsum(clock.action_ticks(clock.actions_within(ticks))) - 1
    # The last action may be incomplete.
    ends = ends[ends < ticks]
    path = np.abs(np.diff(angle[..., ends], axis=-1)).sum(axis=-1)
    return np.asarray(path / ((ends[-1] - ends[0]) / RATE_HZ))


def list_steps(reference: ForceSeries, window: int = PAPER_WINDOW) -> list[tuple[int, int]]:
    """Return (first tick, one past the last tick) of the force after each step between two forces
    that are both held for at least one window."""
    # Both forces must be held for a full window so that the moving average of the reference is
    # constant before and after the step.
    changes = np.flatnonzero((np.diff(reference, axis=0) != 0).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(reference)]
    held = [(start, stop) for start, stop in pairwise(edges) if stop - start >= window]
    starts = {stop for _, stop in held}
    return [(start, stop) for start, stop in held if start in starts]


def settling_times(
    force: ForceSeries,
    reference: ForceSeries,
    settled_n: float = SETTLED_N,
    window: int = PAPER_WINDOW,
) -> Float[np.ndarray, " steps"]:
    """Return the settling time of every step of a reference [s]: the time until the moving average
    of the force stays within `settled_n` of the reference on both axes, until the next change or
    the end. NaN if it never does."""
    average = moving_average(force, window)
    times = []
    for first, stop in list_steps(reference, window):
        # Window k ends with tick k + window - 1, so window `first - window + 1` is the first to
        # contain the new force. It exists because the previous force was held for a full window.
        after = average[first - window + 1 : stop - window + 1]
        # after[k] ends k + 1 ticks after the step; the first settled window follows the last window
        # outside.
        outside = np.flatnonzero(np.abs(after - reference[first]).max(axis=1) > settled_n)
        settled = 0 if not outside.size else int(outside[-1]) + 2
        times.append(settled / RATE_HZ if settled <= len(after) else math.nan)
    return np.array(times)


def data_distance(
    plant: EvaluationTarget, recording: ExperimentRecording
) -> Float[np.ndarray, "references ticks"] | None:
    """Return the distance of the motion from the training data of a surrogate, for the first
    repetition of every reference: 1 at the edge of the data. None for plants that do not estimate
    it."""
    if not isinstance(plant, EnsemblePlant):
        return None
    angle, velocity = recording.command
    commands = Command(jnp.asarray(angle[:, 0]), jnp.asarray(velocity[:, 0]))
    return np.asarray(_run_ensemble(plant, commands))


@eqx.filter_jit
def _run_ensemble(plant: EnsemblePlant, commands: Command) -> Float[Array, "references ticks"]:
    def tick(state: State, command: Command) -> tuple[State, Array]:
        state, _ = plant.advance(state, command, 1)
        return state, plant.distance(state)

    start = plant.init(jax.random.key(0))
    return jax.vmap(lambda issued: jax.lax.scan(tick, start, issued)[1])(commands)


def outside_fraction(distance: Float[np.ndarray, "*references ticks"]) -> float:
    """Return the fraction of the samples outside the training data; 1 in 1000 training samples is
    itself outside."""
    return float((distance > 1).mean())


FEEDBACK_START_S = 6.0
"""Time before which the estimates of feedback are not scored, because it needs two windows [s]."""


def feedback_scores(recording: ExperimentRecording) -> FeedbackScores:
    """Compare the estimates of feedback at constant references with the true force of the same
    windows, in the first repetition."""
    clock = recording.clock
    window = clock.window_ticks
    estimate = jax.tree.map(lambda part: np.asarray(part)[:, 0], recording.estimate)
    ends = np.arange(clock.window_actions, len(estimate.level[0]) + 1, clock.window_actions)
    # A short experiment has only its last window.
    ends = ends[(ends / clock.rate_hz > FEEDBACK_START_S) | (ends == ends[-1])]
    half_width = estimate.half_width[:, ends - 1]
    coverage = None
    if recording.true_force is not None:
        force = np.asarray(recording.true_force)[:, 0]
        starts = (ends // clock.window_actions - 1) * window
        means = np.stack([force[:, start : start + window].mean(axis=1) for start in starts], 1)
        is_within = np.abs(means - estimate.force[:, ends - 1]) <= half_width
        coverage = float(is_within.mean())
    return {
        "half_width_n": half_width.mean(axis=(0, 1)).tolist(),
        "coverage": coverage,
        "level": float(estimate.level.max()),
    }


def outside_warning(distance: Float[np.ndarray, "references ticks"]) -> str | None:
    """Return a warning if too many samples are outside the training data, otherwise None."""
    fraction = outside_fraction(distance)
    if fraction <= MAX_OUTSIDE_FRACTION:
        return None
    return (
        f"{fraction:.1%} of the samples are outside the training data of the surrogate (distance "
        f"up to {distance.max():.1f}; the edge is at 1), so the forces there are extrapolated"
    )
