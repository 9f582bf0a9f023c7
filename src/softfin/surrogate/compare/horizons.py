"""Free-running over logs: a surrogate is warmed on the rows before a stretch and then left alone with its commands.

Logs and places in, predicted readings of these rows out; `softfin.evaluation` scores them. A plant that knows no `warm`
runs whole logs from rest, to be cut into the same stretches.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.core.errors import LogError, PlantError
from softfin.core.plant import Plant, State, check_commands, roll
from softfin.core.quantities import RATE_HZ, Command, Log, Reading

BATCH = 64
"""Stretches side by side, at most: enough for the matrix products, and a few MB of activations."""

Record = TypeVar("Record", Log, Reading)


class FreeRunner(Plant, Protocol):
    """What every surrogate offers beyond a Plant, so that surrogates of any kind can be compared."""

    @property
    def model(self) -> str:
        """The kind of surrogate."""
        ...

    @property
    def memory(self) -> int:
        """Rows of a log that `warm` needs, at least 1."""
        ...

    def warm(self, history: Log) -> State:
        """The state behind a recording of at least `memory` rows: its next tick says row ``len(history)``."""
        ...

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin."""
        ...

    def parameters(self) -> int:
        """Trainable numbers."""
        ...


class Freed(NamedTuple):
    """What was said while it was left alone: NumPy."""

    reading: Reading
    """Fields ``(stretches, ticks)``."""
    members: Float[np.ndarray, "members stretches ticks 2"] | None
    """The forces that the members of an ensemble say [N]; None of a surrogate that is no ensemble."""


class Place(NamedTuple):
    """Where a stretch begins."""

    log: int
    row: int


def places(rows: Sequence[int], ticks: int, first: int) -> list[Place]:
    """Stretches of `ticks` end to end over logs of so many rows, from row `first` on; raises LogError for a short log.

    What is left at a log's end is less than a stretch and belongs to none.
    """
    for index, count in enumerate(rows):
        if count < first + ticks:
            raise LogError(
                f"test log {index}: {count} rows; {first} to begin with and a horizon of {ticks / RATE_HZ:g} s need "
                f"{first + ticks}; record longer test logs, or give shorter --horizons"
            )
    return [Place(i, row) for i, count in enumerate(rows) for row in range(first, count - ticks + 1, ticks)]


def take(records: Sequence[Record], where: Sequence[Place], ticks: int) -> Record:
    """The rows of some stretches, stacked: fields ``(stretches, ticks, ...)``."""
    cut: Record = _stacked([_rows(records[place.log], place.row, place.row + ticks) for place in where])
    return cut


def free_running(
    surrogate: FreeRunner, logs: Sequence[Log], where: Sequence[Place], ticks: int, batch: int = BATCH
) -> Freed:
    """What a surrogate says of stretches that begin at row `memory` or later."""
    size = math.ceil(len(where) / math.ceil(len(where) / batch))
    parts = []
    for begin in range(0, len(where), size):
        some = where[begin : begin + size]
        # Filled up with repeats that are thrown away, so that one compiled program serves all batches.
        filled = [*some, *[some[-1]] * (size - len(some))]
        states = _stacked([surrogate.warm(_rows(logs[log], row - surrogate.memory, row)) for log, row in filled])
        # What row k shows was commanded in row k - 1.
        commands = take(logs, [Place(log, row - 1) for log, row in filled], ticks).command
        freed = _freed(surrogate, jax.tree.map(jnp.asarray, states), jax.tree.map(jnp.asarray, commands))
        kept = len(some)
        parts.append(jax.tree.map(lambda x, kept=kept: np.asarray(x)[:kept], freed))
    reading, members = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    _check_finite(reading, where, f"the {surrogate.model} surrogate")
    return Freed(reading, None if members is None else np.moveaxis(members, 2, 0))


def from_rest(plant: Plant, logs: Sequence[Log], key: PRNGKeyArray) -> list[Reading]:
    """Whole logs by a plant that starts at rest: NumPy, row for row; raises CommandError beyond the plant's limits.

    The command that row 0 shows stands in no log; the first that does is taken for it, as an excitation holds each.
    """
    longest = max(len(log.reading.time) for log in logs)
    issued = []
    for log in logs:
        check_commands(plant.limits, log.command)
        tail = longest - len(log.reading.time)
        issued.append(jax.tree.map(lambda x, tail=tail: np.pad(x[:-1], (1, tail), mode="edge"), log.command))
    commands = jax.tree.map(jnp.asarray, _stacked(issued))
    states = jax.vmap(plant.init)(jax.random.split(key, len(logs)))
    reading = Reading(*map(np.asarray, _roll(plant, states, commands)))
    _check_finite(reading, [Place(index, 0) for index in range(len(logs))], "the plant of the floor")
    each = [Reading(*fields) for fields in zip(*reading, strict=True)]
    return [_rows(one, 0, len(log.reading.time)) for one, log in zip(each, logs, strict=True)]


@eqx.filter_jit
def _freed(surrogate: Any, states: State, commands: Command) -> tuple[Reading, Any]:
    """Fields ``(stretches, ticks)``; of an ensemble also the members' forces ``(stretches, ticks, members, 2)``."""
    if not hasattr(surrogate, "advance_members"):
        return _roll(surrogate, states, commands), None

    def tick(state: State, command: Command) -> tuple[State, Reading]:
        state, each = surrogate.advance_members(state, command, 1)
        return state, jax.tree.map(lambda x: x[:, 0], each)

    each = jax.vmap(lambda state, issued: jax.lax.scan(tick, state, issued)[1])(states, commands)
    mean = Reading(each.time[..., 0], each.angle.mean(-1), each.velocity.mean(-1), each.force.mean(-2))
    return mean, each.force


@eqx.filter_jit
def _roll(plant: Any, states: State, commands: Command) -> Reading:
    def one(state: State, issued: Command) -> Reading:
        return roll(plant, state, issued)[1]

    return jax.vmap(one)(states, commands)


def _rows(record: Record, begin: int, end: int) -> Record:
    cut: Record = jax.tree.map(lambda x: np.asarray(x)[begin:end], record)
    return cut


def _stacked(records: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *records)


def _check_finite(reading: Reading, where: Sequence[Place], who: str) -> None:
    bad = np.argwhere(~np.isfinite(reading.force).all(axis=-1) | ~np.isfinite(reading.angle))
    if bad.size:
        stretch, tick = bad[0]
        log, row = where[stretch]
        raise PlantError(
            f"{who} says no finite number for test log {log}, row {row + tick}, {tick + 1} ticks after it was left "
            "alone; its scores would mean nothing, so leave it out or fit it again"
        )
