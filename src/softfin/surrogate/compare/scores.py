"""Scores the predictions of surrogates for logs: Table I, and free runs over several horizons.

The paper does not state how it normalises the distance of dynamic time warping (DTW). softfin
divides the minimum sum of |difference| over all warping paths within a Sakoe-Chiba band of 1 s by
the number of samples, so the result is at most the mean absolute error. DTW hides a lag, so it is
always reported with the RMSE.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from dtaidistance import dtw
from jaxtyping import Float, PRNGKeyArray

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import EnsemblePlant, Plant, State, check_commands, roll
from softfin.core.quantities import AXES, RATE_HZ, AnyArray, Command, Log, Reading
from softfin.core.window import moving_average
from softfin.surrogate.channels import ANGLE, FORCES, NetPrediction, ranges, to_columns
from softfin.surrogate.protocol import SurrogatePlant

BATCH = 64
"""Maximum number of segments per batch: enough for efficient matrix products, with only a few MB of
activations."""

DTW_BAND = 100
"""Half-width of the Sakoe-Chiba band [samples]. A lag of more than 1 s is a different motion."""

Samples = Float[np.ndarray, "samples"]

Means = Float[np.ndarray, "segments windows 2"]
"""Mean forces over the evaluation window, (x, y) [N]."""

Segment = tuple[int, int]
"""First row of a segment: log index, and row in that log."""

Record = TypeVar("Record")
"""A log or reading, or another named tuple of arrays with time on the first axis."""


def plan_segments(rows: Sequence[int], ticks: int, first: int) -> list[Segment]:
    """Divide logs into consecutive segments.

    Args:
        rows: Number of rows of each log.
        ticks: Length of a segment [rows].
        first: First row of the first segment in each log.

    Raises:
        LogError: a log is too short for one segment.
    """
    for index, count in enumerate(rows):
        if count < first + ticks:
            raise LogError(
                f"test log {index}: {count} rows; the warm-up of {first} rows and a horizon of "
                f"{ticks / RATE_HZ:g} s need "
                f"{first + ticks}; record longer test logs, or use shorter --horizons"
            )
    segments: list[Segment] = []
    for index, count in enumerate(rows):
        starts = range(first, count - ticks + 1, ticks)
        segments.extend(itertools.product((index,), starts))
    return segments


def take(records: Sequence[Record], segments: Sequence[Segment], ticks: int) -> Record:
    """Cut segments out of logs or readings and stack them: fields ``(segments, ticks, ...)``."""
    return _stacked([_rows(records[log], row, row + ticks) for log, row in segments])


def free_run(
    surrogate: SurrogatePlant, logs: Sequence[Log], segments: Sequence[Segment], ticks: int
) -> tuple[Reading, Float[np.ndarray, "members segments ticks 2"] | None]:
    """Predict segments from their commands, warmed up on the rows before each segment.

    Returns:
        The reading, with fields ``(segments, ticks)``, and the force of each member of an
        ensemble [N].
    """
    # Batches of equal size: as many as BATCH requires, each as small as possible.
    size = math.ceil(len(segments) / math.ceil(len(segments) / BATCH))
    # The last batch is padded with repeats, which are dropped below, so that one compiled program
    # works for all batches.
    padded = [*segments, *[segments[-1]] * (-len(segments) % size)]
    parts = []
    for begin in range(0, len(padded), size):
        states = []
        before = []
        for log, row in padded[begin : begin + size]:
            states.append(surrogate.warm(_rows(logs[log], row - surrogate.memory, row)))
            # The reading of row k follows the command of row k - 1.
            before.append((log, row - 1))
        commands = take(logs, before, ticks).command
        parts.append(_free_run(surrogate, _stacked(states), commands))
    reading, members = jax.tree.map(lambda *each: np.concatenate(each)[: len(segments)], *parts)
    return reading, None if members is None else np.moveaxis(members, 2, 0)


def run_from_rest(plant: Plant, logs: Sequence[Log], key: PRNGKeyArray) -> list[Reading]:
    """Predict complete logs with a plant that starts at rest; return NumPy arrays.

    Raises:
        CommandError: a command is outside the plant's limits.
    """
    longest = max(log.rows for log in logs)
    issued = []
    for log in logs:
        check_commands(plant.limits, log.command)
        # The command before row 0 was not recorded, so the first command is repeated. All logs are
        # padded to the same length, so that they run as one batch.
        padding = (1, longest - log.rows)
        issued.append(
            jax.tree.map(lambda x, p=padding: np.pad(x[:-1], p, mode="edge"), log.command)
        )
    states = jax.vmap(plant.init)(jax.random.split(key, len(logs)))
    reading, _ = jax.tree.map(np.asarray, _free_run(plant, states, _stacked(issued)))
    readings = []
    for index, log in enumerate(logs):
        readings.append(jax.tree.map(lambda x, i=index, n=log.rows: x[i, :n], reading))
    return readings


@eqx.filter_jit
def _free_run(
    plant: Plant, states: State, commands: Command
) -> tuple[Reading, Float[AnyArray, "segments ticks members 2"] | None]:
    """Return the reading, with fields ``(segments, ticks)``, and the forces of an ensemble's
    members."""
    if not isinstance(plant, EnsemblePlant):
        return jax.vmap(lambda state, issued: roll(plant, state, issued)[1])(states, commands), None

    def tick(state: State, command: Command) -> tuple[State, Reading]:
        state, each = plant.advance_members(state, command, 1)
        return state, jax.tree.map(lambda x: x[:, 0], each)

    each = jax.vmap(lambda state, issued: jax.lax.scan(tick, state, issued)[1])(states, commands)
    mean = Reading(
        each.time[..., 0], each.angle.mean(-1), each.velocity.mean(-1), each.force.mean(-2)
    )
    return mean, jnp.asarray(each.force)


def _rows(record: Record, begin: int, end: int) -> Record:
    rows: Record = jax.tree.map(lambda x: np.asarray(x)[begin:end], record)
    return rows


def _stacked(records: Sequence[Record]) -> Record:
    stacked: Record = jax.tree.map(lambda *leaves: np.stack(leaves), *records)
    return stacked


def rmse(predicted: AnyArray, measured: AnyArray) -> float:
    """Return the root mean square error."""
    return float(np.sqrt(np.mean(np.square(np.asarray(predicted, np.float64) - measured))))


def mae(predicted: AnyArray, measured: AnyArray) -> float:
    """Return the mean absolute error."""
    return float(np.mean(np.abs(np.asarray(predicted, np.float64) - measured)))


def dtw_mae(predicted: Samples, measured: Samples) -> float:
    """Return the mean absolute difference of one channel after dynamic time warping."""
    # The C code reads the buffers directly. "euclidean" sums |a - b|; the default would sum
    # (a - b)^2 and take the root.
    first = np.ascontiguousarray(predicted, np.float64)
    second = np.ascontiguousarray(measured, np.float64)
    distance = dtw.distance_fast(first, second, window=DTW_BAND, inner_dist="euclidean")
    return float(distance / len(predicted))


TABLE_I_SCORES: Mapping[str, Callable[[Samples, Samples], float]] = {
    "rmse": rmse,
    "mae": mae,
    "dtw_mae": dtw_mae,
}


def table_one(surrogate: SurrogatePlant, logs: Sequence[Log]) -> JsonObject:
    """Return Table I: ``window``, ``parameters`` and scores by network, averaged over logs and
    channels.

    ``physical`` scores are in rad or N. ``scaled`` scores are multiplied by the scale factors of
    the surrogate; if it has none, they are divided by the measured range.
    """
    scales = {}
    for name, span in measured_ranges(logs).items():
        scales[name] = 1 / span
    if surrogate.scaling is not None:
        scales = {name: channel.scale for name, channel in surrogate.scaling.channels.items()}
    table: JsonObject = {}
    for name, prediction in surrogate.predictions(logs).items():
        scores = _table_scores(prediction, logs)
        scaled = scores * [scales[channel] for channel in prediction.channels]
        table[name] = {"window": prediction.window, "parameters": prediction.parameters}
        for unit, values in (("physical", scores), ("scaled", scaled)):
            means = values.mean(axis=(0, 2)).tolist()
            table[name][unit] = dict(zip(TABLE_I_SCORES, means, strict=True))
    return table


def _table_scores(
    prediction: NetPrediction, logs: Sequence[Log]
) -> Float[np.ndarray, "logs scores channels"]:
    channels = prediction.channels
    scores = np.empty((len(logs), len(TABLE_I_SCORES), len(channels)))
    for i, (predicted, log) in enumerate(zip(prediction.series, logs, strict=True)):
        measured = to_columns([log])
        for j, score in enumerate(TABLE_I_SCORES.values()):
            for k, channel in enumerate(channels):
                # Rows before the first complete window have no prediction.
                actual = measured[channel][-len(predicted) :]
                scores[i, j, k] = score(predicted[:, k], actual)
    return scores


def measured_ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Return the range of the measured values of each channel over test logs.

    Raises:
        LogError: a channel never changes.
    """
    spans = {}
    for name, (low, high) in ranges(logs, (ANGLE, *FORCES)).items():
        spans[name] = high - low
        if not high > low:
            raise LogError(
                f"test logs: column {name} is {low:g} in every row, so its predictions cannot be "
                "scored; use test logs in which it changes, or no test logs"
            )
    return spans


class HorizonScores(NamedTuple):
    """Scores of one surrogate at one horizon."""

    scores: dict[str, float]
    """Scores by name, which includes the unit. Horizons shorter than the evaluation window have
    none for the mean force; only ensembles have coverage and half-width."""
    mean_errors: Means | None
    """Errors of the mean force, predicted minus measured."""
    half_widths: Means | None
    """Half-widths of the stated intervals."""


def score_segments(
    measured: Log, predicted: Reading, spans: Mapping[str, float], half_widths: Means | None = None
) -> HorizonScores:
    """Compute the scores that docs/files.md describes, over all segments together.

    Args:
        measured: Measured segments, with fields ``(segments, ticks, ...)``.
        predicted: Predictions of the same segments.
        spans: Range of each channel, from `measured_ranges`.
        half_widths: Half-widths of the intervals for the mean force, if the surrogate has them.
    """
    angle = measured.reading.angle
    force = np.asarray(measured.reading.force)
    pairs = {"angle": (predicted.angle, angle)}
    for i, axis in enumerate(AXES):
        pairs[f"force_{axis}"] = (predicted.force[..., i], force[..., i])
    scores = {}
    distances = []
    for (name, pair), span in zip(pairs.items(), spans.values(), strict=True):
        error = rmse(*pair)
        scores[f"{name}_rmse_{'rad' if name == 'angle' else 'n'}"] = error
        # R^2 = 1 - MSE / variance; -inf or NaN for a channel that is constant in these segments.
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = np.var(np.asarray(pair[1], np.float64))
            scores[f"{name}_r2"] = float(1 - np.square(error) / variance)
        # Warping must not cross from one segment into the next.
        distance = np.mean([dtw_mae(*segment) for segment in zip(*pair, strict=True)])
        distances.append([distance, distance / span])
    scores["angle_mae_rad"] = mae(predicted.angle, angle)
    scores["force_mae_n"] = mae(predicted.force, force)
    scores["angle_dtw_mae_rad"], scores["angle_dtw_mae_scaled"] = map(float, distances[0])
    force_distances = np.mean(distances[1:], axis=0).tolist()
    scores["force_dtw_mae_n"], scores["force_dtw_mae_scaled"] = force_distances
    if angle.shape[1] < PAPER_CLOCK.window_ticks:
        return HorizonScores(scores, None, None)
    mean_errors = moving_average(np.asarray(predicted.force)) - moving_average(force)
    size = np.abs(mean_errors)
    for i, axis in enumerate(AXES):
        scores[f"mean_force_{axis}_mae_n"] = float(size[..., i].mean())
    scores["mean_force_mae_n"] = float(size.mean())
    scores["mean_force_p95_n"] = float(np.quantile(size, 0.95))
    scores["mean_force_worst_n"] = float(size.max())
    if half_widths is not None:
        # Each axis of each mean counts separately, as in the calibration of the interval.
        inside = size <= half_widths
        scores["coverage"] = float(inside.mean())
        scores["half_width_n"] = float(half_widths.mean())
        for i, axis in enumerate(AXES):
            scores[f"coverage_{axis}"] = float(inside[..., i].mean())
    return HorizonScores(scores, mean_errors, half_widths)
