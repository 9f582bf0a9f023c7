"""Free-running predictions of logs and their scores: Table I, and scores over several horizons.

The paper does not say how it normalises the distance of dynamic time warping (DTW). Here it is the
smallest sum of |difference| over all warping paths inside a Sakoe-Chiba band of 1 s, divided by the
number of samples, so it is at most the mean absolute error. It forgives a lag, so it is never
reported without the RMSE.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from dtaidistance import dtw
from jaxtyping import Float, PRNGKeyArray, PyTree

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import EnsemblePlant, Plant, State, check_commands, roll
from softfin.core.quantities import AXES, RATE_HZ, AnyArray, Command, Log, Reading
from softfin.core.window import moving_average
from softfin.surrogate.channels import ANGLE, FORCES, ranges, to_columns
from softfin.surrogate.store import AnySurrogate

BATCH = 64
"""Largest number of segments computed together: enough for efficient matrix products, with a few MB
of activations."""

DTW_BAND = 100
"""Half-width of the band [samples]: a shift of more than a second is no longer the same motion."""

PAPER_TABLE_I = {
    "posnet": {"window": 100, "parameters": 113_601, "rmse": 0.03, "mae": 0.002, "dtw": 0.002},
    "forcenet": {"window": 100, "parameters": 129_794, "rmse": 0.2, "mae": 0.04, "dtw": 0.03},
}
"""The paper's Table I; it does not state units or the normalisation of DTW."""

NETS = {
    "posnet": ("PosNet, commands to angle", "rad", "posnet"),
    "forcenet_measured": ("ForceNet, given the measured angle", "N", "forcenet"),
    "forcenet_free_running": ("ForceNet, free-running behind PosNet", "N", None),
    "drive": ("Drive networks, commands to angle", "rad", "posnet"),
    "force_measured": ("Force networks, given the measured motion", "N", "forcenet"),
    "force_free_running": ("Force networks, free-running behind the drive networks", "N", None),
}
"""Rows of Table I: by key of `table_one`, the description of the row, its unit, and the matching
row of the paper."""

Samples = Float[np.ndarray, "samples"]

Means = Float[np.ndarray, "segments windows 2"]
"""Mean forces over the evaluation window, (x, y) [N]."""


Segment = tuple[int, int]
"""Start of a run of rows: log and row."""


def plan_segments(rows: Sequence[int], ticks: int, first: int) -> list[Segment]:
    """Return consecutive segments of `ticks` in logs with the given numbers of rows, from row
    `first` on; LogError for a short log."""
    for index, count in enumerate(rows):
        if count < first + ticks:
            raise LogError(
                f"test log {index}: {count} rows; the warm-up of {first} rows and a horizon of "
                f"{ticks / RATE_HZ:g} s need "
                f"{first + ticks}; record longer test logs, or give shorter --horizons"
            )
    segments = []
    for index, count in enumerate(rows):
        segments += [(index, row) for row in range(first, count - ticks + 1, ticks)]
    return segments


def take(records: Sequence[PyTree], segments: Sequence[Segment], ticks: int) -> Any:
    """Stack the rows of some segments of logs or readings: fields ``(segments, ticks, ...)``."""
    return _stacked([_rows(records[log], row, row + ticks) for log, row in segments])


def free_run(
    surrogate: AnySurrogate, logs: Sequence[Log], segments: Sequence[Segment], ticks: int
) -> tuple[Reading, Float[np.ndarray, "members segments ticks 2"] | None]:
    """Predict segments from their commands alone, warmed up on the rows before; also return the
    forces of each member [N]."""
    size = math.ceil(len(segments) / math.ceil(len(segments) / BATCH))
    # Padded with repeats that are thrown away, so that one compiled program works for all batches.
    filled = [*segments, *[segments[-1]] * (-len(segments) % size)]
    parts = []
    for begin in range(0, len(filled), size):
        some = filled[begin : begin + size]
        states = _stacked(
            [surrogate.warm(_rows(logs[log], row - surrogate.memory, row)) for log, row in some]
        )
        # The reading of row k follows the command of row k - 1.
        commands = take(logs, [(log, row - 1) for log, row in some], ticks).command
        parts.append(_free_run(surrogate, states, commands))
    reading, members = jax.tree.map(lambda *each: np.concatenate(each)[: len(segments)], *parts)
    return reading, None if members is None else np.moveaxis(members, 2, 0)


def run_from_rest(plant: Plant, logs: Sequence[Log], key: PRNGKeyArray) -> list[Reading]:
    """Predict whole logs, row by row, with a plant that starts at rest; NumPy. Raises CommandError
    for commands outside the plant's limits."""
    longest = max(log.rows for log in logs)
    issued = []
    for log in logs:
        check_commands(plant.limits, log.command)
        # The command before row 0 is in no log; the first command is used for it.
        padding = (1, longest - log.rows)
        issued.append(
            jax.tree.map(lambda x, p=padding: np.pad(x[:-1], p, mode="edge"), log.command)
        )
    states = jax.vmap(plant.init)(jax.random.split(key, len(logs)))
    reading, _ = jax.tree.map(np.asarray, _free_run(plant, states, _stacked(issued)))
    return [
        jax.tree.map(lambda x, i=index, log=log: x[i, : log.rows], reading)
        for index, log in enumerate(logs)
    ]


@eqx.filter_jit
def _free_run(plant: Plant, states: State, commands: Command) -> tuple[Reading, Any]:
    """Fields ``(segments, ticks)``; of an ensemble also the members' forces ``(segments, ticks,
    members, 2)``."""
    if not isinstance(plant, EnsemblePlant):
        return jax.vmap(lambda state, issued: roll(plant, state, issued)[1])(states, commands), None

    def tick(state: State, command: Command) -> tuple[State, Reading]:
        state, each = plant.advance_members(state, command, 1)
        return state, jax.tree.map(lambda x: x[:, 0], each)

    each = jax.vmap(lambda state, issued: jax.lax.scan(tick, state, issued)[1])(states, commands)
    mean = Reading(
        each.time[..., 0], each.angle.mean(-1), each.velocity.mean(-1), each.force.mean(-2)
    )
    return mean, each.force


def _rows(record: PyTree, begin: int, end: int) -> Any:
    return jax.tree.map(lambda x: np.asarray(x)[begin:end], record)


def _stacked(records: Sequence[PyTree]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *records)


def rmse(predicted: AnyArray, measured: AnyArray) -> float:
    """Root mean square error."""
    return float(np.sqrt(np.mean(np.square(np.asarray(predicted, np.float64) - measured))))


def mae(predicted: AnyArray, measured: AnyArray) -> float:
    """Mean absolute error."""
    return float(np.mean(np.abs(np.asarray(predicted, np.float64) - measured)))


def dtw_mae(predicted: Samples, measured: Samples) -> float:
    """Return the mean absolute difference of one channel after warping; see the module."""
    first = np.ascontiguousarray(predicted, np.float64)
    second = np.ascontiguousarray(measured, np.float64)
    distance = dtw.distance_fast(first, second, window=DTW_BAND, inner_dist="euclidean")
    return float(distance / len(predicted))


TABLE_I_SCORES: Mapping[str, Callable[[Samples, Samples], float]] = {
    "rmse": rmse,
    "mae": mae,
    "dtw_mae": dtw_mae,
}


def table_one(surrogate: AnySurrogate, logs: Sequence[Log]) -> JsonObject:
    """Return Table I, with one row per network: ``window``, ``parameters``, and means over logs and
    channels of its scores.

    ``physical`` ones are in rad or N, ``scaled`` ones times the surrogate's scaling, or divided by
    the measured range.
    """
    scales = {name: 1 / span for name, span in measured_ranges(logs).items()}
    if surrogate.scaling is not None:
        scales = {name: channel.scale for name, channel in surrogate.scaling.channels.items()}
    measured = [to_columns([log]) for log in logs]
    table: JsonObject = {}
    for name, (channels, series, window, parameters) in surrogate.predictions(logs).items():
        scores = np.empty((len(logs), len(TABLE_I_SCORES), len(channels)))
        for i, (predicted, actual) in enumerate(zip(series, measured, strict=True)):
            for j, score in enumerate(TABLE_I_SCORES.values()):
                for k, channel in enumerate(channels):
                    # Rows before the first whole window have no prediction.
                    scores[i, j, k] = score(predicted[:, k], actual[channel][-len(predicted) :])
        table[name] = {"window": window, "parameters": parameters}
        scaled = scores * [scales[channel] for channel in channels]
        for unit, values in (("physical", scores), ("scaled", scaled)):
            means = values.mean(axis=(0, 2)).tolist()
            table[name][unit] = dict(zip(TABLE_I_SCORES, means, strict=True))
    return table


def measured_ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Return the range of the measured values of each channel over test logs; raises LogError if a
    channel never changes."""
    spans = {}
    for name, (low, high) in ranges(logs, (ANGLE, *FORCES)).items():
        spans[name] = high - low
        if not high > low:
            raise LogError(
                f"test logs: column {name} is {low:g} in every row, so that no prediction of it "
                "can be scored; give test logs in which it changes, or none"
            )
    return spans


class HorizonScores(NamedTuple):
    """Scores of one surrogate at one horizon."""

    scores: dict[str, float]
    """Scores by name with unit; those of the mean force and its interval only if they exist."""
    mean_errors: Means | None
    """Errors of the mean force, predicted minus measured."""
    half_widths: Means | None
    """Half-width of the stated interval of each."""


def score_segments(
    measured: Log, predicted: Reading, spans: Mapping[str, float], half_widths: Means | None = None
) -> HorizonScores:
    """Score segments, fields ``(segments, ticks)``, as docs/files.md describes; `spans` are
    `measured_ranges`."""
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
        # R^2 = 1 - MSE / variance; a channel that never changes has none.
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = np.var(np.asarray(pair[1], np.float64))
            scores[f"{name}_r2"] = float(1 - np.square(error) / variance)
        distance = np.mean([dtw_mae(*one) for one in zip(*pair, strict=True)])
        distances.append([distance, distance / span])
    scores["angle_mae_rad"] = mae(predicted.angle, angle)
    scores["force_mae_n"] = mae(predicted.force, force)
    scores["angle_dtw_mae_rad"], scores["angle_dtw_mae_scaled"] = map(float, distances[0])
    force_distances = np.mean(distances[1:], axis=0).tolist()
    scores["force_dtw_mae_n"], scores["force_dtw_mae_scaled"] = force_distances
    if angle.shape[1] < WINDOW:
        return HorizonScores(scores, None, None)
    mean_errors = moving_average(np.asarray(predicted.force)) - moving_average(force)
    size = np.abs(mean_errors)
    for i, axis in enumerate(AXES):
        scores[f"mean_force_{axis}_mae_n"] = float(size[..., i].mean())
    scores["mean_force_mae_n"] = float(size.mean())
    scores["mean_force_p95_n"] = float(np.quantile(size, 0.95))
    scores["mean_force_worst_n"] = float(size.max())
    if half_widths is not None:
        inside = size <= half_widths
        scores["coverage"] = float(inside.mean())
        scores["half_width_n"] = float(half_widths.mean())
        for i, axis in enumerate(AXES):
            scores[f"coverage_{axis}"] = float(inside[..., i].mean())
    return HorizonScores(scores, mean_errors, half_widths)
