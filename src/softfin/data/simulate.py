"""Simulates many plants, each with its own commands.

One compiled program advances all plants by a chunk of rows at a time.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray, PyTree

from softfin.core.compilation import jit
from softfin.core.plant import Plant, State, roll
from softfin.core.quantities import Command, Limits, Log, Reading
from softfin.data.excitation import Commands

CHUNK_ROWS = 1000
"""Approximate number of rows per call of the compiled program; progress is reported after each
call. The overhead of a call is negligible for 10 s of plant time."""

ReportRows = Callable[[int], None]
"""Function that is called with the number of rows finished since the last call."""


@runtime_checkable
class MeasuringPlant(Plant, Protocol):
    """A plant that also simulates additional channels of a log (`softfin.core.log_channels`)."""

    def measure(
        self, state: State, command: Command
    ) -> tuple[State, Reading, dict[str, Float[Array, ""]]]:
        """Hold the command for one tick; return the state, the reading and the channels."""


def simulate(
    plants: Sequence[Plant],
    keys: Sequence[PRNGKeyArray],
    rows: int,
    commands: Commands,
    batch: int,
    report: ReportRows,
    channels: bool = False,
) -> Iterator[Log]:
    """Yield one log of `rows` rows per plant and key, as NumPy arrays; at most `batch` run at once.
    With `channels`, the plants must be `MeasuringPlant`s.

    Plants whose pytrees differ only in array values run together; other plants run one after
    another.
    """
    same = all(plant is plants[0] for plant in plants)
    parts = []
    kinds = []
    for plant in plants[:1] if same else plants:
        arrays, static = eqx.partition(plant, eqx.is_array)
        parts.append((arrays, static))
        # Plants can share a program if they differ only in the values of their arrays.
        shapes = jax.tree.map(lambda x: (x.shape, x.dtype), arrays)
        kinds.append(jax.tree.flatten((static, shapes)))
    if any(kind != kinds[0] for kind in kinds):
        for plant, key in zip(plants, keys, strict=True):
            yield from simulate([plant], [key], rows, commands, 1, report, channels)
        return
    count = len(plants)
    # Equal batch sizes, to minimize padding.
    batch = math.ceil(count / math.ceil(count / batch)) if count else 0
    for start in range(0, count, batch or 1):
        # The last batch is padded with logs that are later discarded, so that all batches have the
        # same shape and share one compiled program.
        index = [i % count for i in range(start, start + batch)]
        (arrays, static) = parts[0]
        axis = None
        if not same:
            axis = 0
            members = [parts[i][0] for i in index]
            arrays = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
        fleet = _Fleet(arrays, static, axis, channels)
        batch_keys = jnp.stack([keys[i] for i in index])
        state, issued = _begin(fleet, batch_keys, rows + 1, commands)
        yield from _logs(fleet, state, issued, rows, min(batch, count - start), report)


class _Fleet(NamedTuple):
    """Plants that share one program, split into static parts and arrays.

    The arrays are stacked along `axis`, or shared by all plants if it is None.
    """

    arrays: PyTree
    static: PyTree
    axis: int | None
    channels: bool
    """Whether to return channels as well."""


@jit("none")
def _begin(
    fleet: _Fleet, keys: Key[Array, "logs"], rows: int, commands: Commands
) -> tuple[State, Command]:
    """Return the initial states and all commands of a batch."""

    def one(arrays: PyTree, key: PRNGKeyArray) -> tuple[State, Command]:
        plant = eqx.combine(arrays, fleet.static)
        plant_key, command_key = jax.random.split(key)
        return plant.init(plant_key), commands(command_key, rows, Limits(*plant.limits))

    begun: tuple[State, Command] = jax.vmap(one, in_axes=(fleet.axis, 0))(fleet.arrays, keys)
    return begun


Measured: TypeAlias = tuple[Reading, dict[str, Array]]
"""Readings and channels."""


@jit("low")
def _advance(fleet: _Fleet, state: State, issued: Command) -> tuple[State, Measured]:
    """Advance a batch through one chunk of commands."""

    def one(arrays: PyTree, state: State, issued: Command) -> tuple[State, Measured]:
        plant = eqx.combine(arrays, fleet.static)
        if not fleet.channels:
            state, reading = roll(plant, state, issued)
            return state, (reading, {})

        def tick(state: State, command: Command) -> tuple[State, Measured]:
            state, reading, channels = plant.measure(state, command)
            return state, (reading, channels)

        return jax.lax.scan(tick, state, issued)

    rolled: tuple[State, Measured] = jax.vmap(one, in_axes=(fleet.axis, 0, 0))(
        fleet.arrays, state, issued
    )
    return rolled


def _logs(
    fleet: _Fleet, state: State, commands: Command, rows: int, wanted: int, report: ReportRows
) -> list[Log]:
    """Roll a batch through its commands ``(batch, rows + 1)``; row k has reading k and the command
    issued at that time."""
    chunks = math.ceil(rows / CHUNK_ROWS)
    chunk = math.ceil(rows / chunks)
    # Commands are repeated past the end, so that all chunks have the same length and share one
    # program; the extra rows are cut off below.
    issued = jax.tree.map(
        lambda x: jnp.pad(x, ((0, 0), (0, chunk * chunks - rows)), mode="edge"), commands
    )
    pieces = []
    for start in range(0, rows, chunk):
        state, piece = _advance(
            fleet, state, jax.tree.map(lambda x, start=start: x[:, start : start + chunk], issued)
        )
        pieces.append(jax.tree.map(lambda x: np.asarray(x[:wanted]), piece))
        report(wanted * min(chunk, rows - start))
    measured = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :rows], *pieces)
    command = jax.tree.map(lambda x: np.asarray(x[:, 1:]), commands)
    return [Log(*jax.tree.map(lambda x, i=i: x[i], (command, *measured))) for i in range(wanted)]
