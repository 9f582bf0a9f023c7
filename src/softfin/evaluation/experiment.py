"""The paper's experiment: from rest, a controller holds a reference force on a plant, 3 actions a second (Sec. IV).

Controller, plant and reference forces go in, a Recording of every 10 ms comes out; all references and seeds run side
by side in one compiled program.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.control.controller import Controller, ControllerState, Measured
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
    command, reading = _program((controller, _Same(plant)), jnp.asarray(references, jnp.float32), seconds, keys)
    return Recording(references, command, reading)


class _Same(eqx.Module):
    """A plant as an argument of a compiled program: its arrays are traced, an object without arrays is itself."""

    parts: Any
    whole: "_Itself | None" = eqx.field(static=True)

    def __init__(self, plant: Plant) -> None:
        opaque = jax.tree.leaves(plant) == [plant] if not eqx.is_array(plant) else False
        self.parts, self.whole = (None, _Itself(plant)) if opaque else (plant, None)

    def plant(self) -> Plant:
        """The plant again."""
        plant: Plant = self.parts if self.whole is None else self.whole.plant
        return plant


@dataclasses.dataclass(frozen=True, eq=False)
class _Itself:
    """Compared by being the same object, whatever the object says of equality; so it can be looked up."""

    plant: Plant

    def __hash__(self) -> int:
        return id(self.plant)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and other.plant is self.plant


@eqx.filter_jit
def _program(
    parties: tuple[Controller, _Same], references: Float[Array, "references 2"], seconds: int, keys: Key[Array, "seeds"]
) -> tuple[Command, Reading]:
    """Compiled once for controllers and plants that are alike but for their arrays."""
    controller, plant = parties[0], parties[1].plant()

    def one(reference: Float[Array, "2"], key: PRNGKeyArray) -> tuple[Command, Reading]:
        carry = (controller.init(), plant.init(key), Measured(jnp.float32(0.0), jnp.zeros(2)))
        kept: tuple[Command, Reading]
        _, kept = jax.lax.scan(lambda carry, _: _second(controller, plant, reference, carry), carry, None, seconds)
        command, reading = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), kept)
        return command, reading

    each: tuple[Command, Reading] = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(references, keys)
    return each


def _second(
    controller: Controller, plant: Plant, reference: Float[Array, "2"], carry: tuple[ControllerState, State, Measured]
) -> tuple[tuple[ControllerState, State, Measured], tuple[Command, Reading]]:
    """Three actions of 33, 33 and 34 ticks, each on what was read while the one before it was held."""
    memory, state, measured = carry
    kept = []
    for ticks in ACTION_TICKS:
        memory, command = controller.act(memory, measured, reference)
        state, reading = plant.advance(state, command, ticks)
        measured = Measured(reading.angle[-1], reading.force.mean(axis=0))
        kept.append((jax.tree.map(lambda x, n=ticks: jnp.full(n, x, jnp.float32), command), reading))
    return (memory, state, measured), jax.tree.map(lambda *parts: jnp.concatenate(parts), *kept)
