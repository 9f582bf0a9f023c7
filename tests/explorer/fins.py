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
from softfin.tank import Tank, TankConfig, with_parameters

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


def roll_tank(
    tank: Tank, commands: Command, double: bool, factors: np.ndarray | None = None
) -> np.ndarray:
    """Angle, velocity, force, and torque on the fin and of the motor after each command, with
    factors of stiffness and drag during each ``(ticks, 2)``."""
    if factors is None:
        factors = np.ones((len(commands.angle), 2), np.float32)

    def roll(tank: Tank, state: Any, commands: Command, factors: Any) -> Any:
        def tick(state: Any, given: Any) -> Any:
            command, (stiffness, drag) = given
            changed = with_parameters(tank, stiffness=stiffness, drag=drag)
            state, reading, _ = changed.tick(state, command)
            motion = jnp.stack([reading.angle, reading.velocity])
            return state, jnp.concatenate([motion, reading.force, state.torque])

        return jax.lax.scan(tick, state, (commands, factors))[1]

    given = (tank, tank.init(jax.random.key(0)), commands, factors)
    if not double:
        return np.asarray(jax.jit(roll)(*given))
    with doubles():
        return np.asarray(jax.jit(roll)(*as_doubles(given)))


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
