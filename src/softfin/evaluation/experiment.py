"""The paper's experiment: from rest, a controller holds a reference force on a plant, 3 actions a second (Sec. IV).

Controller, plant and reference forces, constant or moving, go in, a Recording of every 10 ms comes out; all references
and seeds run side by side in one compiled program.
"""

from itertools import accumulate
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.action_clock import ACTION_TICKS
from softfin.control.controller import Controller, ControllerState, Measured
from softfin.errors import ConfigurationError, PlantError
from softfin.plant import Plant, State
from softfin.plant_identity import jit_argument
from softfin.quantities import RATE_HZ, AnyArray, Command, Limits, Reading

ACTION_STARTS = (0, *accumulate(ACTION_TICKS[:-1]))
"""Ticks of each second at which a controller acts."""

MIN_SECONDS = 3
"""Shorter experiments hold hardly more than the first window of the moving average [s]."""


class Recording(NamedTuple):
    """What was asked, commanded and read, in ticks of 10 ms."""

    reference: Float[AnyArray, "references *ticks 2"]
    """(x, y) [N]: one force for the whole experiment, or one a tick, in force while the reading of that tick came
    about."""
    command: Command
    """Fields ``(references, seeds, ticks)``: the command under which the reading of that tick came about."""
    reading: Reading
    """Fields ``(references, seeds, ticks)``, force ``(references, seeds, ticks, 2)``."""


@runtime_checkable
class RealTime(Protocol):
    """A fin that no program can simulate, with the controller that it was given: experiments take their time."""

    @property
    def limits(self) -> Limits:
        """The commands that it takes."""
        ...

    def experiments(
        self, references: Float[np.ndarray, "references *ticks 2"], seconds: int, repetitions: int
    ) -> Recording:
        """Every reference so many times, one after the other, each from rest."""
        ...


Subject: TypeAlias = Plant | RealTime
"""What a controller is judged on."""


def run(
    controller: Controller,
    plant: Subject,
    references: Float[AnyArray, "references *ticks 2"],
    seconds: int,
    keys: Key[Array, "seeds"],
) -> Recording:
    """Run every reference with every key of the plant, each from rest, for whole seconds.

    A reference is one force, or one a tick of which the controller sees that of the tick at which it acts.
    """
    if isinstance(plant, RealTime):
        return plant.experiments(np.asarray(references, np.float32), seconds, len(keys))
    asked = jnp.asarray(_at_actions(np.asarray(references, np.float32), seconds))
    command, reading = _program((controller, jit_argument(plant)), asked, keys)
    return Recording(references, command, reading)


def _at_actions(
    references: Float[np.ndarray, "references *ticks 2"], seconds: int
) -> Float[np.ndarray, "references seconds 3 2"]:
    if references.ndim == 2:
        return np.tile(references[:, None, None], (1, seconds, len(ACTION_TICKS), 1))
    count, ticks = references.shape[:2]
    if ticks != seconds * RATE_HZ:
        raise ConfigurationError(
            f"references of {ticks} ticks for an experiment of {seconds} s; give {seconds * RATE_HZ} ticks, one every "
            "10 ms"
        )
    return references.reshape(count, seconds, RATE_HZ, 2)[:, :, list(ACTION_STARTS)]


def check_finite(recording: Recording) -> None:
    """Raise PlantError where a reading is no number; the scores of such an experiment would mean nothing."""
    bad = np.argwhere(~np.isfinite(recording.reading.force).all(axis=-1) | ~np.isfinite(recording.reading.angle))
    if bad.size:
        index, seed, tick = bad[0]
        command = [float(part[index, seed, tick]) for part in recording.command]
        asked = np.asarray(recording.reference)[index]
        x, y = asked if asked.ndim == 1 else asked[tick]
        raise PlantError(
            f"reference ({x:g}, {y:g}) N, seed {seed}, {(tick + 1) / RATE_HZ:.2f} s: force or angle is no finite "
            f"number after the command (angle {command[0]:.3f} rad, velocity {command[1]:.3f} rad/s); every reading of "
            "a plant must be finite"
        )


def first_of(recording: Recording) -> Recording:
    """The first seed alone, its axis kept, as NumPy arrays."""
    command, reading = jax.tree.map(lambda x: np.asarray(x[:, :1]), (recording.command, recording.reading))
    return Recording(np.asarray(recording.reference), command, reading)


def alike(recording: Recording) -> bool:
    """Whether all seeds did the same, as those of a plant without randomness do."""
    force = np.asarray(recording.reading.force)
    return bool((force == force[:, :1]).all())


@eqx.filter_jit
def _program(
    parties: tuple[Controller, Plant], references: Float[Array, "references seconds 3 2"], keys: Key[Array, "seeds"]
) -> tuple[Command, Reading]:
    """Compiled once for controllers and plants that are alike but for their arrays."""
    controller, plant = parties

    def one(asked: Float[Array, "seconds 3 2"], key: PRNGKeyArray) -> tuple[Command, Reading]:
        carry = (controller.init(), plant.init(key), Measured(jnp.float32(0.0), jnp.zeros(2)))
        kept: tuple[Command, Reading]
        _, kept = jax.lax.scan(lambda carry, asked: _second(controller, plant, asked, carry), carry, asked)
        command, reading = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), kept)
        return command, reading

    each: tuple[Command, Reading] = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(references, keys)
    return each


def _second(
    controller: Controller, plant: Plant, asked: Float[Array, "3 2"], carry: tuple[ControllerState, State, Measured]
) -> tuple[tuple[ControllerState, State, Measured], tuple[Command, Reading]]:
    """Three actions of 33, 33 and 34 ticks, each on what was read while the one before it was held."""
    memory, state, measured = carry
    kept = []
    for reference, ticks in zip(asked, ACTION_TICKS, strict=True):
        memory, command = controller.act(memory, measured, reference)
        state, reading = plant.advance(state, command, ticks)
        measured = Measured(reading.angle[-1], reading.force.mean(axis=0))
        kept.append((jax.tree.map(lambda x, n=ticks: jnp.full(n, x, jnp.float32), command), reading))
    return (memory, state, measured), jax.tree.map(lambda *parts: jnp.concatenate(parts), *kept)
