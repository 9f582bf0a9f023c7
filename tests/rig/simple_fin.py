"""A fin behind emulated devices that needs no JAX."""

import math
import threading

from softfin.core.clock import REAL, Clock
from softfin.emulation.fin import COAST_RAD_S2, FinMotion

SIMPLE_FORCE_N = 0.5
"""Force of a simple fin at 1 rad/s."""


class SimpleFin:
    """Follows its profile exactly, at constant velocity to the target; its force is proportional to
    its velocity."""

    def __init__(self, clock: Clock = REAL) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._start = 0.0
        self._began = clock()
        self._target = 0.0
        self._velocity = 1.0

    def move(self, angle: float, velocity: float) -> None:
        """Begin where the fin is now."""
        with self._lock:
            self._start, self._began = self._angle(), self._clock()
            self._target = angle
            self._velocity = velocity

    def halt(self) -> None:
        """Stop at once."""
        with self._lock:
            self._start = self._target = self._angle()

    def coast(self) -> None:
        """Go on at half the velocity for as far as `COAST_RAD_S2` would let it: for as long,
        too."""
        with self._lock:
            angle = self._angle()
            way = math.copysign(self._velocity**2 / (2 * COAST_RAD_S2), self._target - angle)
            if self._target == angle:
                way = 0.0
            self._began = self._clock()
            self._start = angle
            self._target = angle + way
            self._velocity /= 2

    def now(self) -> FinMotion:
        """Force towards -x while it turns to positive angles."""
        with self._lock:
            angle = self._angle()
            rest = self._target - angle
            velocity = 0.0 if rest == 0 else math.copysign(self._velocity, rest)
        return FinMotion(
            angle,
            velocity,
            angle,
            abs(velocity),
            (-SIMPLE_FORCE_N * velocity, 0.0, 0.0, 0.0, 0.0, 0.0),
        )

    def _angle(self) -> float:
        way = self._target - self._start
        passed = self._velocity * (self._clock() - self._began)
        # The target itself, which start + way may miss by a rounding error: then the fin would
        # never be at rest.
        return self._target if passed >= abs(way) else self._start + math.copysign(passed, way)
