"""A fin behind emulated devices that needs no JAX and brakes like a mass, so that its way to rest
can be measured."""

import math
import threading
from typing import NamedTuple

from softfin.core.clock import REAL, Clock
from softfin.emulation.fin import COAST_RAD_S2, FinMotion

FORCE_N = 0.5
"""Force of the fin at 1 rad/s, against its motion."""


class _Motion(NamedTuple):
    """A motion at constant deceleration, which ends at rest."""

    start: float
    began: float
    velocity: float
    deceleration: float
    duration: float

    def at(self, time: float) -> tuple[float, float]:
        """Return angle [rad] and velocity [rad/s]."""
        passed = min(time - self.began, self.duration)
        slowdown = math.copysign(self.deceleration, self.velocity)
        angle = self.start + self.velocity * passed - slowdown * passed**2 / 2
        is_over = time - self.began >= self.duration
        return angle, 0.0 if is_over else self.velocity - slowdown * passed


class BrakingFin:
    """Turns at constant velocity to its target; a halt brakes at `quick_stop_rad_s2`."""

    def __init__(self, quick_stop_rad_s2: float, clock: Clock = REAL) -> None:
        self._quick_stop_rad_s2 = quick_stop_rad_s2
        self._clock = clock
        self._lock = threading.Lock()
        self._motion = _Motion(0.0, clock(), 0.0, 0.0, 0.0)

    def move(self, angle: float, velocity: float) -> None:
        with self._lock:
            now = self._clock()
            here, _ = self._motion.at(now)
            way = angle - here
            self._motion = _Motion(
                here, now, math.copysign(velocity, way), 0.0, abs(way) / velocity
            )

    def halt(self) -> None:
        self._brake(self._quick_stop_rad_s2)

    def coast(self) -> None:
        self._brake(COAST_RAD_S2)

    def now(self) -> FinMotion:
        with self._lock:
            angle, velocity = self._motion.at(self._clock())
        return FinMotion(
            angle, velocity, angle, abs(velocity), (-FORCE_N * velocity, 0.0, 0.0, 0.0, 0.0, 0.0)
        )

    def _brake(self, deceleration: float) -> None:
        with self._lock:
            now = self._clock()
            angle, velocity = self._motion.at(now)
            self._motion = _Motion(angle, now, velocity, deceleration, abs(velocity) / deceleration)
