"""Turns one fin's mean force into a gait: strokes to both sides of the direction in which it
pushes. NumPy only.

Still water looks the same in all directions, so one family of gaits about a centre is enough for a
fin that turns without limit: strokes of one action each, 1.5 Hz, whose amplitude determines the
force and whose centre its direction. Their mean force points along the centre; across it they make
a ripple, which is the largest force of all.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray, Command, Limits

MOVING = 0.85
"""Fraction of an action in which the shaft moves; the rest is time to accelerate and to brake."""


FinVector = Float[AnyArray, "2"]
"""(x, y) in the axes of a fin."""


class FinGaits(NamedTuple):
    """Gaits of a fin by their mean force; the first is rest."""

    force: Float[np.ndarray, "gaits"]
    """Mean force along the direction of pushing [N], ascending from 0."""
    amplitude: Float[np.ndarray, "gaits"]
    """Angle of a stroke to either side [rad]."""
    ripple: Complex[np.ndarray, "gaits 2"]
    """Ripple at the stroke frequency, for strokes that begin to the positive side: force across the
    direction of pushing [N], and moment about the shaft [N m]."""
    stream_loss: Float[np.ndarray, "gaits 2"]
    """Force lost per velocity of the fin through the water, along and across the direction of
    pushing [N s/m]."""
    limits: Limits
    """Limits of the drive's velocity; angles are not limited."""

    @property
    def reach(self) -> float:
        """Greatest mean force [N]."""
        return float(self.force[-1])

    def find_amplitude(self, force_n: float) -> float:
        """Return the amplitude of a mean force [rad]."""
        return float(np.interp(force_n, self.force, self.amplitude))

    def stroke_ripple(self, force_n: Float[np.ndarray, "fins"]) -> Complex[np.ndarray, "fins 2"]:
        """Return the ripple of mean forces."""
        return np.stack([np.interp(force_n, self.force, part) for part in self.ripple.T], axis=1)

    def lost(self, force: FinVector, velocity: FinVector) -> FinVector:
        """Return the loss of a mean force while the fin moves through the water [N]; both in the
        fin's axes [N, m/s]."""
        xp = select_operations(force, velocity).xp
        squared = force @ force + SMALL_N**2
        part = (velocity @ force) / squared * force
        along, across = (
            xp.interp(xp.sqrt(squared), self.force, loss) for loss in self.stream_loss.T
        )
        lost: Float[AnyArray, 2] = along * part + across * (velocity - part)
        return lost

    def stroke_velocity(self, way_rad: float) -> float:
        """Return the velocity at which a fin arrives within its action, or the nearest one within
        the drive's limits."""
        wanted = way_rad * ACTION_RATE_HZ / MOVING
        return min(max(wanted, self.limits.velocity_min), self.limits.velocity_max)


SMALL_N = 0.05
"""A force below this has no steady direction [N]."""

WEAK_N = 1e-6
"""A force below this has no direction [N]."""


class DriverState(NamedTuple):
    """State of a fin's driver."""

    direction: float
    """Centre angle of its strokes [rad]; may be any number of turns."""
    target: float
    """Last commanded angle [rad]."""


REST = DriverState(0.0, 0.0)
"""Return the state of a fin at rest at angle 0."""


def fin_command(angle_rad: float, velocity_rad_s: float) -> Command:
    """Return a command of plain numbers, as drives and messages need them."""
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
        # At angle a the fin's thrust points along (cos a, -sin a); the fin takes the shorter way
        # there.
        direction += math.remainder(math.atan2(-y, x) - direction, 2 * math.pi)
    target = direction + side * gaits.find_amplitude(size)
    velocity = gaits.stroke_velocity(abs(target - state.target))
    return DriverState(direction, target), fin_command(target, velocity)
