"""Convert a fin's mean force to a gait: strokes to both sides of the thrust direction. NumPy only.

Still water is the same in all directions, so one family of gaits is enough for a fin with unlimited
rotation: strokes of one action each, at 1.5 Hz, whose amplitude determines the force and whose
centre determines its direction. The mean force points along the centre; the ripple across it is the
largest force of all.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray, Command, Limits

MOVING = 0.85
"""Fraction of an action in which the shaft moves; the rest is for acceleration and braking."""


FinVector = Float[AnyArray, "2"]
"""(x, y) in the axes of a fin."""


class FinGaits(NamedTuple):
    """Gaits of a fin, by mean force; the first is rest."""

    force: Float[np.ndarray, "gaits"]
    """Mean thrust [N], ascending from 0."""
    amplitude: Float[np.ndarray, "gaits"]
    """Stroke angle to either side [rad]."""
    ripple: Complex[np.ndarray, "gaits 2"]
    """Complex ripple at the stroke frequency, for strokes that start to the positive side: side
    force [N] and moment about the shaft [N m]."""
    stream_loss: Float[np.ndarray, "gaits 2"]
    """Force lost per velocity of the fin through the water, along and across the thrust [N s/m]."""
    limits: Limits
    """Velocity limits of the drive; angles are unlimited."""

    @property
    def reach(self) -> float:
        """Maximum mean force [N]."""
        return float(self.force[-1])

    def find_amplitude(self, force_n: float) -> float:
        """Return the stroke amplitude for a mean force [rad]."""
        return float(np.interp(force_n, self.force, self.amplitude))

    def stroke_ripple(self, force_n: Float[np.ndarray, "fins"]) -> Complex[np.ndarray, "fins 2"]:
        """Return the ripple for mean forces [N]."""
        return np.stack([np.interp(force_n, self.force, part) for part in self.ripple.T], axis=1)

    def lost(self, force: FinVector, velocity: FinVector) -> FinVector:
        """Return the loss of a mean force [N] while the fin moves through the water at a velocity
        [m/s], all in the fin's axes."""
        xp = select_operations(force, velocity).xp
        squared = force @ force + SMALL_N**2
        part = (velocity @ force) / squared * force
        # Split the velocity into parts along and across the force. SMALL_N keeps the direction
        # finite at zero force.
        along, across = (
            xp.interp(xp.sqrt(squared), self.force, loss) for loss in self.stream_loss.T
        )
        lost: Float[AnyArray, 2] = along * part + across * (velocity - part)
        return lost

    def stroke_velocity(self, way_rad: float) -> float:
        """Return the velocity needed to turn by an angle within one action, clamped to the drive's
        limits."""
        wanted = way_rad * PAPER_CLOCK.rate_hz / MOVING
        return min(max(wanted, self.limits.velocity_min), self.limits.velocity_max)


SMALL_N = 0.05
"""Force below which the direction is not reliable [N]."""

WEAK_N = 1e-6
"""Force below which there is no direction [N]."""


class DriverState(NamedTuple):
    """State of a fin's driver."""

    direction: float
    """Centre angle of the strokes [rad], not wrapped."""
    target: float
    """Last commanded angle [rad]."""


REST = DriverState(0.0, 0.0)
"""State of a fin at rest at angle 0."""


def fin_command(angle_rad: float, velocity_rad_s: float) -> Command:
    """Return a command of plain numbers, as needed by drives and messages."""
    command: Any = Command
    numbers: Command = command(angle_rad, velocity_rad_s)
    return numbers


def stroke(
    gaits: FinGaits, state: DriverState, force: Any, side: int
) -> tuple[DriverState, Command]:
    """Return the next stroke, to the given side, for a mean force (x, y) in the fin's axes [N]."""
    x = float(force[0])
    y = float(force[1])
    size = math.hypot(x, y)
    direction = state.direction
    if size > WEAK_N:
        # At angle a the thrust points along (cos a, -sin a); the fin turns there the shorter way.
        direction += math.remainder(math.atan2(-y, x) - direction, 2 * math.pi)
    target = direction + side * gaits.find_amplitude(size)
    velocity = gaits.stroke_velocity(abs(target - state.target))
    return DriverState(direction, target), fin_command(target, velocity)
