"""The paper's experiment: from rest, a controller holds a reference force on a plant, 3 actions a second (Sec. IV).

Controller, plant and reference forces go in, a Recording of every 10 ms comes out; all references and seeds run side
by side in one compiled program.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.control.controller import Controller, ControllerState
from softfin.plant import ACTION_TICKS, Plant, State
from softfin.quantities import AnyArray, Command, Reading


class Recording(NamedTuple):
    """What was asked, commanded and read, in ticks of 10 ms."""

    reference: Float[AnyArray, "references 2"]
    """(x, y) [N]"""
    command: Command
    """Fields ``(references, seeds, ticks)``: the command under which the reading of that tick came about."""
    reading: Reading
    """Fields ``(references, seeds, ticks)``, force ``(references, seeds, ticks, 2)``."""


def run(
    controller: Controller,
    plant: Plant,
    references: Float[AnyArray, "references 2"],
    seconds: int,
    keys: Key[Array, "seeds"],
) -> Recording:
    """Run every reference with every key of the plant, each from rest, for whole seconds."""
    # Arrays are arguments of the program, not constants in it; the rest may be any object, hashable or not.
    arrays, static = eqx.partition((controller, plant), eqx.is_array)

    def one(arrays: Any, reference: Float[Array, "2"], key: PRNGKeyArray) -> tuple[Command, Reading]:
        controller, plant = eqx.combine(arrays, static)
        carry = (controller.init(), plant.init(key), jnp.float32(0.0))
        _, kept = jax.lax.scan(lambda carry, _: _second(controller, plant, reference, carry), carry, None, seconds)
        command, reading = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), kept)
        return command, reading

    program = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, None, 0)), in_axes=(None, 0, None)))
    command, reading = program(arrays, jnp.asarray(references, jnp.float32), keys)
    return Recording(references, command, reading)


def _second(
    controller: Controller, plant: Plant, reference: Float[Array, "2"], carry: tuple[ControllerState, State, Any]
) -> tuple[tuple[ControllerState, State, Any], tuple[Command, Reading]]:
    """Three actions of 33, 33 and 34 ticks, each on the angle that was read last (0, at rest, before the first)."""
    memory, state, angle = carry
    kept = []
    for ticks in ACTION_TICKS:
        memory, command = controller.act(memory, angle, reference)
        state, reading = plant.advance(state, command, ticks)
        angle = reading.angle[-1]
        kept.append((jax.tree.map(lambda x, n=ticks: jnp.full(n, x, jnp.float32), command), reading))
    return (memory, state, angle), jax.tree.map(lambda *parts: jnp.concatenate(parts), *kept)
