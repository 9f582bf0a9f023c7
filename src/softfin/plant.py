"""The Plant contract: what moves when commanded. The virtual tank, every surrogate, one's own simulator are Plants.

A plant is pure and traceable, so that `jit`, `vmap`, `scan` and `grad` go through it.
"""

from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from softfin.action_clock import ACTION_TICKS
from softfin.errors import CommandError
from softfin.program_cache import use_program_cache
from softfin.quantities import Command, Limits, Reading

# Here, as whatever compiles a program of softfin's imports this module.
use_program_cache()

State: TypeAlias = PyTree[Any]


@runtime_checkable
class Plant(Protocol):
    """A fin, real enough to learn from: one fin, no batch axes (`jax.vmap` adds them)."""

    @property
    def limits(self) -> Limits:
        """The commands that the plant takes [rad, rad/s]; beyond them its readings mean nothing."""
        ...

    def init(self, key: PRNGKeyArray) -> State:
        """The fin at rest at angle 0, time 0. The key draws whatever is random (sensor noise, conditions)."""
        ...

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        """Hold the scalar command for `ticks` samples of 10 ms (static) and read after each: fields ``(ticks,)``."""
        ...


def check_commands(limits: Limits, commands: Command) -> None:
    """Refuse commands beyond the limits, where their values are known: not while a program is being compiled."""
    for name, unit, channel, low, high in (
        ("angle", "rad", commands.angle, limits.angle_min, limits.angle_max),
        ("velocity", "rad/s", commands.velocity, limits.velocity_min, limits.velocity_max),
    ):
        if isinstance(channel, jax.core.Tracer):
            continue
        values = np.asarray(channel)
        # Limits are kept in double precision, commands in single.
        outside = ~((values >= low - 1e-6) & (values <= high + 1e-6))
        if outside.any():
            raise CommandError(
                f"command {name} = {values[outside].flat[0]:g} {unit}: the plant takes {low:g} to {high:g} {unit}"
            )


def roll(plant: Plant, state: State, commands: Command) -> tuple[State, Reading]:
    """Issue one command a tick, ``(ticks,)``, and read after each; raises CommandError beyond the plant's limits."""
    check_commands(plant.limits, commands)

    def tick(state: State, command: Command) -> tuple[State, Reading]:
        state, reading = plant.advance(state, command, 1)
        return state, jax.tree.map(lambda x: x[0], reading)

    return jax.lax.scan(tick, state, commands)


def rest_command(limits: Limits) -> Command:
    """The command under which a fin at rest at angle 0 stays there: angle 0 at the least velocity."""
    return Command(jnp.float32(0.0), jnp.float32(limits.velocity_min))


def hold(plant: Plant, state: State, actions: Command) -> tuple[State, Reading]:
    """Hold each of ``(actions,)`` commands on the 3.0 Hz clock; fields ``(ticks,)`` with 100 ticks for 3 actions."""
    check_commands(plant.limits, actions)
    cycles, rest = divmod(actions.angle.shape[0], len(ACTION_TICKS))

    def some(state: State, commands: Command, count: int) -> tuple[State, Reading]:
        readings = []
        for i in range(count):
            command = jax.tree.map(lambda x, i=i: x[i], commands)
            state, reading = plant.advance(state, command, ACTION_TICKS[i])
            readings.append(reading)
        return state, jax.tree.map(lambda *parts: jnp.concatenate(parts), *readings)

    whole = jax.tree.map(lambda x: x[: cycles * 3].reshape(cycles, 3), actions)
    state, reading = jax.lax.scan(lambda s, c: some(s, c, 3), state, whole)
    reading = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), reading)
    if rest:
        state, tail = some(state, jax.tree.map(lambda x: x[cycles * 3 :], actions), rest)
        reading = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), reading, tail)
    return state, reading
