"""Free-running over logs: a surrogate is warmed on the rows before a segment and then gets its commands alone."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.core.errors import LogError, PlantError
from softfin.core.plant import EnsemblePlant, Plant, State, check_commands, roll
from softfin.core.quantities import RATE_HZ, Command, Log, Reading
from softfin.surrogate.store import AnySurrogate

BATCH = 64
"""Segments side by side, at most: enough for the matrix products, and a few MB of activations."""

Tree = TypeVar("Tree")


class Segment(NamedTuple):
    """Where a run of rows begins."""

    log: int
    row: int


def segments_of(rows: Sequence[int], ticks: int, first: int) -> list[Segment]:
    """Segments of `ticks` end to end over logs of so many rows, from row `first` on; raises LogError for a short log.

    What is left at a log's end is less than a segment and belongs to none.
    """
    for index, count in enumerate(rows):
        if count < first + ticks:
            raise LogError(
                f"test log {index}: {count} rows; {first} to begin with and a horizon of {ticks / RATE_HZ:g} s need "
                f"{first + ticks}; record longer test logs, or give shorter --horizons"
            )
    return [Segment(i, row) for i, count in enumerate(rows) for row in range(first, count - ticks + 1, ticks)]


def take(records: Sequence[Tree], segments: Sequence[Segment], ticks: int) -> Tree:
    """The rows of some segments of logs or readings, stacked: fields ``(segments, ticks, ...)``."""
    return _stacked([_rows(records[log], row, row + ticks) for log, row in segments])


def free_run(
    surrogate: AnySurrogate, logs: Sequence[Log], segments: Sequence[Segment], ticks: int
) -> tuple[Reading, Float[np.ndarray, "members segments ticks 2"] | None]:
    """Predict segments that begin at row `memory` or later, ``(segments, ticks)``, and the forces of each member [N].

    NumPy; None for the members of a surrogate that is not an ensemble.
    """
    size = math.ceil(len(segments) / math.ceil(len(segments) / BATCH))
    parts = []
    for begin in range(0, len(segments), size):
        some = segments[begin : begin + size]
        # Filled up with repeats that are thrown away, so that one compiled program serves all batches.
        filled = [*some, *[some[-1]] * (size - len(some))]
        states = _stacked([surrogate.warm(_rows(logs[log], row - surrogate.memory, row)) for log, row in filled])
        # What row k shows was commanded in row k - 1.
        commands = take(logs, [Segment(log, row - 1) for log, row in filled], ticks).command
        predicted = _free_run(surrogate, states, commands)
        parts.append(_rows(predicted, 0, len(some)))
    reading, members = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    _check_finite(reading, f"the {surrogate.model} surrogate")
    return reading, None if members is None else np.moveaxis(members, 2, 0)


def run_from_rest(plant: Plant, logs: Sequence[Log], key: PRNGKeyArray) -> list[Reading]:
    """Whole logs by a plant that starts at rest: NumPy, row for row; raises CommandError beyond the plant's limits.

    The command that row 0 shows stands in no log; the first that does is taken for it, as an excitation holds each.
    """
    rows = [len(log.reading.time) for log in logs]
    issued = []
    for log, count in zip(logs, rows, strict=True):
        check_commands(plant.limits, log.command)
        issued.append(Command(*(np.pad(x[:-1], (1, max(rows) - count), mode="edge") for x in log.command)))
    states = jax.vmap(plant.init)(jax.random.split(key, len(logs)))
    reading, _ = _free_run(plant, states, _stacked(issued))
    _check_finite(reading, "the plant of the noise floor")
    return [Reading(*(np.asarray(field)[index, :count] for field in reading)) for index, count in enumerate(rows)]


@eqx.filter_jit
def _free_run(plant: Any, states: State, commands: Command) -> tuple[Reading, Any]:
    """Fields ``(segments, ticks)``; of an ensemble also the members' forces ``(segments, ticks, members, 2)``."""
    if not isinstance(plant, EnsemblePlant):
        return jax.vmap(lambda state, issued: roll(plant, state, issued)[1])(states, commands), None

    def tick(state: State, command: Command) -> tuple[State, Reading]:
        state, each = plant.advance_members(state, command, 1)
        return state, jax.tree.map(lambda x: x[:, 0], each)

    each = jax.vmap(lambda state, issued: jax.lax.scan(tick, state, issued)[1])(states, commands)
    mean = Reading(each.time[..., 0], each.angle.mean(-1), each.velocity.mean(-1), each.force.mean(-2))
    return mean, each.force


def _rows(record: Tree, begin: int, end: int) -> Tree:
    cut: Tree = jax.tree.map(lambda x: np.asarray(x)[begin:end], record)
    return cut


def _stacked(records: Sequence[Tree]) -> Tree:
    stacked: Tree = jax.tree.map(lambda *leaves: np.stack(leaves), *records)
    return stacked


def _check_finite(reading: Reading, who: str) -> None:
    if not all(np.isfinite(field).all() for field in reading):
        raise PlantError(
            f"{who} predicts a value that is not finite; its scores would mean nothing, so leave it out or fit it again"
        )
