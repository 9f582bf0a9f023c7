"""The simplest gait, to have something to look at: strokes to and fro about a centre, one an action of the 3 Hz clock.

A configuration and a plant's limits go in, one command a tick comes out.
"""

import numpy as np
from pydantic import Field

from softfin.core.action_clock import ACTION_RATE_HZ, ACTION_TICKS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import Command, Limits


class BeatConfig(Configuration):
    """Where the fin beats, and how far."""

    centre_rad: float = 0.0
    """Angle about which it beats [rad]; the mean force turns with it, a positive one towards -y."""
    amplitude_rad: float = Field(0.5, ge=0)
    """Of the commanded angle on either side of the centre [rad]; half a radian, as a fin that swims forward beats."""
    velocity_rad_s: float | None = Field(None, gt=0)
    """Of each stroke [rad/s]; None: what fills two thirds of an action with it, as far as the plant's limits let it."""


def beat(config: BeatConfig, limits: Limits, ticks: int) -> Command:
    """One command a tick, fields ``(ticks,)``; raises ConfigurationError for what the plant does not take."""
    low, high = config.centre_rad - config.amplitude_rad, config.centre_rad + config.amplitude_rad
    if low < limits.angle_min or high > limits.angle_max:
        raise ConfigurationError(
            f"beat: {config.centre_rad:g} rad with strokes of {config.amplitude_rad:g} rad either side reaches "
            f"{low:.3g} .. {high:.3g} rad; the plant takes {limits.angle_min:.3g} .. {limits.angle_max:.3g}; "
            "ask for a centre nearer to the middle, or for a smaller beat.amplitude_rad"
        )
    actions = -(-ticks // min(ACTION_TICKS))
    held = ticks_of(actions)
    sides = np.resize((1.0, -1.0), actions)
    angle = np.repeat(config.centre_rad + config.amplitude_rad * sides, held)[:ticks]
    velocity = np.full(ticks, velocity_of(config, limits))
    return Command(angle.astype(np.float32), velocity.astype(np.float32))


def velocity_of(config: BeatConfig, limits: Limits) -> float:
    """The commanded velocity [rad/s]."""
    if config.velocity_rad_s is None:
        strokes = 2 * config.amplitude_rad * ACTION_RATE_HZ / (2 / 3)
        return min(max(strokes, limits.velocity_min), limits.velocity_max)
    if not limits.velocity_min <= config.velocity_rad_s <= limits.velocity_max:
        raise ConfigurationError(
            f"beat.velocity_rad_s = {config.velocity_rad_s:g}: the plant takes {limits.velocity_min:.3g} .. "
            f"{limits.velocity_max:.3g} rad/s; ask within it"
        )
    return config.velocity_rad_s
