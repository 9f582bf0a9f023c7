"""A machine that needs no device and no time: a fin that turns at constant velocity, on a clock
that the test moves."""

import math
import threading
from collections.abc import Callable

from softfin.control.controller import Measured
from softfin.core.clock import REAL, Clock
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from softfin.rig.computer import Computer
from softfin.rig.machine import Sample, Target

FORCE_DELAY_S = 0.02


class Hours(Computer):
    """A clock that the test moves, or the sleep of its loop; other threads wait in real time."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        # Rounding must not leave a sleeper before its time.
        self.now += seconds + 1e-9


class FreeFin:
    """Meets the Machine contract; every call is noted in `calls`, `altered` changes what is
    read."""

    def __init__(self, clock: Clock = REAL) -> None:
        self.name = "free fin"
        self.limits = Limits(*map(float, PAPER_LIMITS))
        self.notes: tuple[str, ...] = ()
        self.stop_unconfirmed: str | None = None
        self.clock = clock
        self.calls: list[str] = []
        self.altered: Callable[[Sample], Sample] = lambda sample: sample
        self.enabled = False
        self.commands: list[Target] = []
        self._lock = threading.RLock()
        self._angle = 0.0
        self._target = Target(0.0, 1.0)
        self._at = clock()

    def open(self) -> None:
        self.calls.append("open")

    def read(self) -> Sample:
        with self._lock:
            velocity = self._advance()
            now = self.clock()
            wrench = (-0.5 * velocity, 0.1, 0.0, 0.0, 0.0, 0.0)
            sample = Sample(now, self._angle, velocity, 0.5, 0.0, now - FORCE_DELAY_S, wrench, ())
        return self.altered(sample)

    def enable(self) -> None:
        with self._lock:
            self.calls.append("enable")
            self._advance()
            self.enabled = True
            self._target = Target(self._angle, 1.0)

    def command(self, target: Target) -> None:
        with self._lock:
            self.calls.append("command")
            self.commands.append(target)
            self._advance()
            self._target = target

    def stop(self) -> None:
        with self._lock:
            self.calls.append("stop")
            self._advance()
            self.enabled = False

    def close(self) -> None:
        self.stop()
        self.calls.append("close")

    def counters(self) -> dict[str, int]:
        return {"sensor_lost": 0}

    @property
    def angle(self) -> float:
        """Where it is now."""
        with self._lock:
            self._advance()
            return self._angle

    def turn(self, angle: float) -> None:
        """By hand."""
        self._angle = angle

    def _advance(self) -> float:
        passed = self.clock() - self._at
        self._at = self.clock()
        rest = self._target.angle - self._angle if self.enabled else 0.0
        step = math.copysign(min(abs(rest), self._target.velocity * passed), rest)
        self._angle += step
        return 0.0 if abs(step) < 1e-9 else math.copysign(self._target.velocity, rest)


class Notes:
    """A recorder; what it is told goes into the machine's `calls`, so that the order is known."""

    def __init__(self, machine: FreeFin) -> None:
        self.failure: str | None = None
        self.events: list[str] = []
        self.rows: list[str] = []
        self._calls = machine.calls

    def command(self, time: float, angle: float, velocity: float) -> None:
        self.rows.append("command")

    def joint(
        self,
        time: float,
        angle: float,
        velocity: float,
        current: float | None,
        voltage: float | None,
    ) -> None:
        self.rows.append("joint")

    def wrench(self, time: float, wrench: tuple[float, ...]) -> None:
        self.rows.append("wrench")

    def reference(self, time: float, force: tuple[float, ...]) -> None:
        self.rows.append("reference")

    def event(self, time: float, text: str) -> None:
        self._calls.append(f"event {text}")
        self.events.append(text)


class Wagging:
    """A controller that goes from side to side, and may do worse at an action."""

    def __init__(self, worse: Callable[[int], Target | None] = lambda action: None) -> None:
        self.limits = Limits(*map(float, PAPER_LIMITS))
        self.asked: list[tuple[float, float]] = []
        self.forces: list[tuple[float, float]] = []
        self.drives: list[tuple[object, object]] = []
        self._worse = worse

    def init(self) -> int:
        return 0

    def act(
        self, state: int, measured: Measured, reference: tuple[float, float]
    ) -> tuple[int, Command]:
        self.asked.append(reference)
        self.forces.append(measured.force)
        self.drives.append((measured.shaft, measured.motor))
        target = self._worse(state) or Target(0.5 if state % 2 else -0.5, 2.0)
        return state + 1, Command(*target)

    def check(self, reference: tuple[float, float]) -> None:
        """Everything is covered."""
