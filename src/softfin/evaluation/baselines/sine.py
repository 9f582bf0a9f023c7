"""A sine of the shaft as commands to the drive, one a tick: the beat that open-loop baselines are made of.

The drive runs a velocity profile to its target angle, so the target goes along the sine and the profile velocity, which
is a ceiling, stays at the sine's greatest speed. A ceiling that follows the sine's own speed holds the profile back at
each turn: on the virtual tank a sine of 0.4 rad and 2 Hz then comes out as one of 0.25 rad, and as 0.39 rad this way.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S, AnyArray, Command, Limits


class Sine(NamedTuple):
    """angle(t) = centre + amplitude sin(2 pi frequency t)."""

    centre: Float[AnyArray, "*shape"]
    """[rad]"""
    amplitude: Float[AnyArray, "*shape"]
    """[rad], not negative."""
    frequency: Float[AnyArray, "*shape"]
    """[Hz]"""


class Clipped(NamedTuple):
    """Share of the ticks at which a plant's limits kept the commands from the sine."""

    angle: Float[Array, "*shape"]
    """The sine is beyond the angles that the plant takes."""
    velocity: Float[Array, "*shape"]
    """The sine is faster than the plant may be told to turn."""


def commanded(limits: Limits, sine: Sine, ticks: int) -> tuple[Command, Clipped]:
    """Fields ``(*shape, ticks)`` within the limits, and how much of each sine they clip.

    A profile velocity that is raised to the plant's least one clips nothing: the target angle still sets the pace.
    """
    centre, amplitude, frequency = (jnp.asarray(part, jnp.float32)[..., None] for part in sine)
    # The command of a tick shows in the reading at its end.
    turn = 2 * jnp.pi * frequency * (jnp.arange(ticks) + 1) * TICK_S
    angle = centre + amplitude * jnp.sin(turn)
    fastest = 2 * jnp.pi * frequency * amplitude
    outside = (angle < limits.angle_min - ROUNDING) | (angle > limits.angle_max + ROUNDING)
    fast = fastest * jnp.abs(jnp.cos(turn)) > limits.velocity_max + ROUNDING
    velocity = jnp.broadcast_to(jnp.clip(fastest, limits.velocity_min, limits.velocity_max), angle.shape)
    command = Command(jnp.clip(angle, limits.angle_min, limits.angle_max), velocity)
    return command, Clipped(outside.mean(axis=-1), fast.mean(axis=-1))


ROUNDING = 1e-6
"""Of single precision, about the greatest angles [rad] and velocities [rad/s]."""
