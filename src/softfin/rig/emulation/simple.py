"""A fin that follows its profile exactly and whose force is its velocity's: enough to test devices, no JAX."""

import math
import threading

from softfin.core.clock import REAL, Clock
from softfin.rig.emulation.fin import Motion

FORCE_N = 0.5
"""At 1 rad/s."""


class SimpleFin:
    """Meets the EmulatedFin contract: constant velocity to the target, at once."""

    def __init__(self, clock: Clock = REAL) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._start, self._began, self._target, self._velocity = 0.0, clock(), 0.0, 1.0

    def move(self, angle: float, velocity: float) -> None:
        """From where it is now."""
        with self._lock:
            self._start, self._began = self._angle(), self._clock()
            self._target, self._velocity = angle, velocity

    def halt(self) -> None:
        """At once."""
        with self._lock:
            self._start = self._target = self._angle()

    def now(self) -> Motion:
        """Force towards -x while it turns to positive angles."""
        with self._lock:
            angle = self._angle()
            rest = self._target - angle
            velocity = 0.0 if rest == 0 else math.copysign(self._velocity, rest)
        return Motion(angle, velocity, angle, abs(velocity), (-FORCE_N * velocity, 0.0, 0.0, 0.0, 0.0, 0.0))

    def _angle(self) -> float:
        way, passed = self._target - self._start, self._velocity * (self._clock() - self._began)
        # The target itself, which start + way may miss by a rounding error: then the fin would never be at rest.
        return self._target if passed >= abs(way) else self._start + math.copysign(passed, way)
