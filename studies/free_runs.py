"""Free runs: surrogates predict stretches of test logs from their commands alone, and are scored."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import LogError
from softfin.core.plant import EnsemblePlant, Plant, State, check_commands, roll
from softfin.core.quantities import AXES, RATE_HZ, AnyArray, Command, Log, Reading
from softfin.core.window import moving_average
from softfin.surrogate import SurrogatePlant
from softfin.surrogate.table_one import rmse

BATCH = 64
"""Maximum number of segments per batch: enough for efficient matrix products, with only a few MB of
activations."""

Means = Float[np.ndarray, "segments windows 2"]
"""Mean forces over the evaluation window, (x, y) [N]."""

Segment = tuple[int, int]
"""First row of a segment: log index, and row in that log."""

Record = TypeVar("Record")
"""A log or reading, or another named tuple of arrays with time on the first axis."""


class FreeRun(NamedTuple):
    """Predictions of segments from their commands."""

    reading: Reading
    """Fields ``(segments, ticks)``."""
    half_widths: Means | None
    """Half-widths of an ensemble's intervals for the mean force [N]."""


def plan_segments(rows: Sequence[int], ticks: int, first: int) -> list[Segment]:
    """Divide logs of `rows` rows into consecutive segments of `ticks` rows; each log's first
    segment starts at row `first`. Raises LogError if a log is too short for one segment."""
    segments: list[Segment] = []
    for index, count in enumerate(rows):
        if count < first + ticks:
            raise LogError(
                f"test log {index}: {count} rows; the warm-up of {first} rows and a horizon of "
                f"{ticks / RATE_HZ:g} s need {first + ticks}; record longer test logs, or use "
                "shorter horizons"
            )
        starts = range(first, count - ticks + 1, ticks)
        segments.extend(itertools.product((index,), starts))
    return segments


def take(records: Sequence[Record], segments: Sequence[Segment], ticks: int) -> Record:
    """Cut segments out of logs or readings and stack them: fields ``(segments, ticks, ...)``."""
    return _stack([_cut(records[log], row, row + ticks) for log, row in segments])


def free_run(
    surrogate: SurrogatePlant, logs: Sequence[Log], segments: Sequence[Segment], ticks: int
) -> FreeRun:
    """Predict segments from their commands, warmed up on the rows before each segment."""
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
            states.append(surrogate.warm(_cut(logs[log], row - surrogate.memory, row)))
            # The reading of row k follows the command of row k - 1.
            before.append((log, row - 1))
        commands = take(logs, before, ticks).command
        parts.append(_run(surrogate, _stack(states), commands))
    reading, members = jax.tree.map(lambda *each: np.concatenate(each)[: len(segments)], *parts)
    half_widths = None
    if isinstance(surrogate, EnsemblePlant) and ticks >= PAPER_CLOCK.window_ticks:
        means = moving_average(np.moveaxis(members, 2, 0))
        half_widths = np.asarray(surrogate.interval.half_width(means))
    return FreeRun(reading, half_widths)


def run_from_rest(plant: Plant, logs: Sequence[Log], key: PRNGKeyArray) -> list[Reading]:
    """Predict complete logs with a plant that starts at rest. Raises CommandError if a command is
    outside the plant's limits."""
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
    reading, _ = jax.tree.map(np.asarray, _run(plant, states, _stack(issued)))
    readings = []
    for index, log in enumerate(logs):
        readings.append(jax.tree.map(lambda x, i=index, n=log.rows: x[i, :n], reading))
    return readings


@eqx.filter_jit
def _run(
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
    return mean, each.force


def _cut(record: Record, begin: int, end: int) -> Record:
    return jax.tree.map(lambda x: np.asarray(x)[begin:end], record)


def _stack(records: Sequence[Record]) -> Record:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *records)


def mean_force_errors(measured: Reading, predicted: Reading) -> Means:
    """Return the errors of the mean force, predicted minus measured."""
    return moving_average(np.asarray(predicted.force)) - moving_average(np.asarray(measured.force))


def score_segments(
    measured: Reading, predicted: Reading, half_widths: Means | None = None
) -> dict[str, float]:
    """Score predictions over all segments together, with fields ``(segments, ticks, ...)``.

    Segments shorter than the evaluation window have no score for the mean force; only ensembles
    have a coverage.
    """
    scores = {"angle_rmse_rad": rmse(predicted.angle, measured.angle)}
    for i, axis in enumerate(AXES):
        scores[f"force_{axis}_rmse_n"] = rmse(predicted.force[..., i], measured.force[..., i])
    if measured.angle.shape[1] < PAPER_CLOCK.window_ticks:
        return scores
    size = np.abs(mean_force_errors(measured, predicted))
    scores["mean_force_mae_n"] = float(size.mean())
    scores["mean_force_p95_n"] = float(np.quantile(size, 0.95))
    if half_widths is not None:
        # Each axis of each mean counts separately, as in the calibration of the interval.
        inside = size <= half_widths
        scores["coverage"] = float(inside.mean())
        for i, axis in enumerate(AXES):
            scores[f"coverage_{axis}"] = float(inside[..., i].mean())
    return scores
