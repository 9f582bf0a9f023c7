"""Plants for the page's tests, and their programs in double precision, in which rounding hides no
slip."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import Command
from softfin.surrogate import StreamingSurrogate
from softfin.tank import Tank, TankConfig

QUIET = {"noise_n": 0, "drift_n": 0, "resolution_n": 0}
"""The parts of the sensor that the page leaves out."""

UNUSUAL = TankConfig.build(
    {
        "drive": {"backlash_rad": 0.02, "dead_time_s": 0.034, "torque_limit_nm": 0.4},
        "fin": {"plates": 3, "tip_span_ratio": 0.7, "tip_thickness_ratio": 0.4},
        "water": {"drag_exponent": 0.33},
        "sensor": {**QUIET, "misalignment_rad": 0.1, "range_n": 4},
        "steps_per_tick": 3,
    },
    "unusual",
)
"""A tank in which everything counts that does nothing in the default one: play, limits, taper,
memory of strokes."""


@contextmanager
def doubles() -> Iterator[None]:
    """Programs in double precision."""
    with jax.enable_x64(True):
        yield


def as_doubles(tree: Any) -> Any:
    return jax.tree.map(
        lambda x: jnp.asarray(x, np.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def roll_tank(tank: Tank, commands: Command, double: bool) -> np.ndarray:
    """Angle, velocity and force after each command."""

    def roll(tank: Tank, state: Any, commands: Command) -> Any:
        def tick(state: Any, command: Command) -> Any:
            state, reading, _ = tank.tick(state, command)
            return state, jnp.concatenate(
                [jnp.stack([reading.angle, reading.velocity]), reading.force]
            )

        return jax.lax.scan(tick, state, commands)[1]

    state = tank.init(jax.random.key(0))
    if not double:
        return np.asarray(jax.jit(roll)(tank, state, commands))
    with doubles():
        return np.asarray(jax.jit(roll)(*as_doubles((tank, state, commands))))


@jax.jit
def _roll(members: Any, state: Any, commands: Command) -> Any:
    def one(member: Any, own: Any) -> Any:
        return jax.lax.scan(lambda state, command: member.step(state, command), own, commands)

    state, (motion, force) = jax.vmap(one)(members, state)
    mean = force.mean(axis=0)
    return (
        state,
        jnp.column_stack([motion.angle.mean(axis=0), motion.velocity.mean(axis=0), mean]),
        force,
    )


def roll_surrogate(surrogate: StreamingSurrogate) -> Any:
    """State at rest, and the function of a state and commands to the next state, readings and
    forces of members."""
    with doubles():
        members, rest = as_doubles((surrogate.members, surrogate.rest))

    def roll(state: Any, commands: Command) -> Any:
        with doubles():
            state, reading, forces = _roll(
                members, state, Command(*(jnp.asarray(x, np.float64) for x in commands))
            )
        return state, np.asarray(reading), np.asarray(forces)

    return rest, roll
