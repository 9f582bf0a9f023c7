"""The motor of an emulated EPOS2: modes of operation, profile position, homing; the fin behind it in counts and rpm."""

import math
from collections.abc import Callable

from softfin.rig.emulation.drive_setpoints import HALT, NEW_SETPOINT, Setpoints
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.epos2 import objects
from softfin.rig.epos2.config import Units
from softfin.rig.epos2.objects import Object

MODES = frozenset({objects.PROFILE_POSITION, objects.HOMING, 3, -1, -2, -3})
POSITION_LIMIT = 0xFF09
"""Emergency: the set-point lies outside the drive's own limits."""


class Motion:
    """`value(entry)` is the drive's object, `fault(code)` its fault."""

    def __init__(
        self, fin: EmulatedFin, units: Units, value: Callable[[Object], int], fault: Callable[[int], None]
    ) -> None:
        self._fin, self._units, self._value, self._fault = fin, units, value, fault
        self.ignored = 0
        """So many of the next set-points are not taken."""
        self.power_up()

    def power_up(self) -> None:
        """The zero is lost."""
        self._mode = objects.PROFILE_POSITION
        self._homed = self.referenced = False
        self._stalled_at: int | None = None
        self._word = 0
        # An incremental encoder counts from wherever it wakes up; [counts] of the fin's own angle.
        self.zero = self._units.counts(self._fin.now().angle)
        self.halt()

    def halt(self) -> None:
        """Brake and forget where to."""
        self._fin.halt()
        self._setpoints = Setpoints()

    def stall(self) -> None:
        """The fin stays where it is while the profile goes on."""
        self._stalled_at = self.position

    @property
    def mode(self) -> int:
        """One of `MODES`; a change of it ends a homing."""
        return self._mode

    @mode.setter
    def mode(self, mode: int) -> None:
        self._mode, self._homed = mode, False

    @property
    def position(self) -> int:
        """[counts]"""
        return self._counts(self._fin.now().angle) if self._stalled_at is None else self._stalled_at

    @property
    def demand(self) -> int:
        """Where the profile is [counts]."""
        return self._counts(self._fin.now().demand)

    @property
    def rpm(self) -> int:
        """Of the motor."""
        return self._units.signed_rpm(0.0 if self._stalled_at is not None else self._fin.now().velocity)

    @property
    def current(self) -> int:
        """[mA]"""
        current = self._fin.now().current
        return int(math.copysign(min(abs(round(1000 * current)), 0x7FFF), current))

    @property
    def is_target_reached(self) -> bool:
        """Bit 10 of the statusword: the profile has ended, or without one, or halted, the shaft is at rest."""
        if self._setpoints.goal is None or self._word & HALT:
            return self.rpm == 0
        return self._setpoints.is_reached(self.demand)

    @property
    def is_acknowledged(self) -> bool:
        """Bit 12 of the statusword: set-point acknowledged, or home attained."""
        return self._homed if self._mode == objects.HOMING else self._setpoints.acknowledged

    def control(self, word: int, before: int) -> None:
        """A controlword while operation is enabled."""
        self._word = word
        if word & HALT:
            self._fin.halt()
        is_new = bool(word & ~before & NEW_SETPOINT)
        if self._mode == objects.HOMING:
            if is_new and self._value(objects.HOMING_METHOD) == objects.HOME_HERE:
                self.zero += self.position
                self.referenced = self._homed = True
        elif self._mode == objects.PROFILE_POSITION:
            if is_new and self.ignored:
                self.ignored -= 1
            elif self._setpoints.control(word, before, self._value(objects.TARGET), self.demand):
                self._move()

    def tick(self) -> None:
        """While operation is enabled."""
        if self._setpoints.follow_on(self.demand):
            self._move()

    def _move(self) -> None:
        goal = self._setpoints.goal
        assert goal is not None
        if not self._value(objects.POSITION_MIN) <= goal <= self._value(objects.POSITION_MAX):
            self._fault(POSITION_LIMIT)
            return
        rpm = min(self._value(objects.PROFILE_VELOCITY), self._value(objects.FASTEST))
        self._fin.move(self._units.angle(goal + self.zero), abs(self._units.velocity(rpm)))

    def _counts(self, angle: float) -> int:
        return self._units.counts(angle) - self.zero
