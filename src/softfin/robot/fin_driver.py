"""One fin's mean force as a gait: strokes to both sides of the direction that it pushes in. NumPy
alone.

Still water looks alike in all directions, so that one family of gaits about a centre serves a fin
that turns all the way round: strokes of one action each, 1.5 Hz, whose amplitude decides over the
force and whose centre over its direction. Their mean force lies along the centre; across it they
make a ripple, which is the greatest force of all.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray, Command, Limits

MOVING = 0.85
"""Part of an action in which the shaft moves: what is left is time to speed up and to brake."""


FinVector = Float[AnyArray, "2"]
"""(x, y) in the axes of a fin."""


class FinGaits(NamedTuple):
    """Gaits of a fin by their mean force, the first of them rest."""

    force: Float[np.ndarray, "gaits"]
    """Mean force along the direction of pushing [N], ascending from 0."""
    amplitude: Float[np.ndarray, "gaits"]
    """Angle of a stroke to either side [rad]."""
    ripple: Complex[np.ndarray, "gaits 2"]
    """Ripple of the strokes' own frequency, where strokes begin to the positive side: force across
    the direction of pushing [N], and moment about the shaft [N m]."""
    stream_loss: Float[np.ndarray, "gaits 2"]
    """Force lost per velocity of the fin through the water, along and across the direction of
    pushing [N s/m]."""
    limits: Limits
    """Velocities of the drive; angles are not limited."""

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
        """Return what a mean force loses where the fin moves through the water [N]; both in the
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
        """Return the velocity at which a fin arrives within its action, or the nearest that the
        drive has."""
        wanted = way_rad * ACTION_RATE_HZ / MOVING
        return min(max(wanted, self.limits.velocity_min), self.limits.velocity_max)


SMALL_N = 0.05
"""A force below this has no steady direction [N]."""

WEAK_N = 1e-6
"""A force below this has no direction [N]."""


class DriverState(NamedTuple):
    """State of a fin's driver."""

    direction: float
    """Angle of the shaft about which it strokes [rad]; any number of turns."""
    target: float
    """Angle that was commanded last [rad]."""


REST = DriverState(0.0, 0.0)
"""A fin at rest at angle 0."""


def fin_command(angle_rad: float, velocity_rad_s: float) -> Command:
    """Return a command of plain numbers, as drives and messages take them."""
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
        # At angle a the fin's thrust points along (cos a, -sin a); the shorter way round leads
        # there.
        direction += math.remainder(math.atan2(-y, x) - direction, 2 * math.pi)
    target = direction + side * gaits.find_amplitude(size)
    velocity = gaits.stroke_velocity(abs(target - state.target))
    return DriverState(direction, target), fin_command(target, velocity)
