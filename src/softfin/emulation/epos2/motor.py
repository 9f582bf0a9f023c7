"""Power stage and motor of an emulated EPOS2: states, profile position mode and homing, with the
fin in counts and rpm.

Every target takes effect immediately, as requested by our driver; relative targets are ignored.
"""

from collections.abc import Callable

from softfin.emulation.fin import EmulatedFin
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Units
from softfin.rig.devices.epos2.protocol import Object, State

NEW_TARGET_BIT = 1 << 4
RELATIVE_BIT = 1 << 6
"""Controlword bits."""
POSITION_LIMIT = 0xFF09
"""Emergency code: the target is outside the limits of the drive."""

BY_ITSELF = {
    State.START: State.NOT_READY,
    State.NOT_READY: State.SWITCH_ON_DISABLED,
    State.REFRESH: State.MEASURE_INIT,
    State.MEASURE_INIT: State.OPERATION_ENABLED,
    State.FAULT_REACTION_DISABLED: State.FAULT,
}
"""Successors of states that a drive leaves by itself after one step."""


def next_state(state: State, word: int, before: int) -> State:
    """Return the state after controlword `word`, with `before` the previous one: CiA 402 with
    maxon's two additional states."""
    # The reset is a rising edge of bit 7.
    if state is State.FAULT and word & ~before & protocol.FAULT_RESET:
        return State.SWITCH_ON_DISABLED
    if (
        state in protocol.FAULT_STATES
        or state in (State.START, State.NOT_READY)
        or word & protocol.FAULT_RESET
    ):
        return state
    # Bit 1, enable voltage, is 0.
    if not word & 2:
        return State.SWITCH_ON_DISABLED
    # Bit 2, quick stop, is active low.
    if not word & 4:
        return State.QUICK_STOP_ACTIVE if state in protocol.POWERED else State.SWITCH_ON_DISABLED
    if state is State.QUICK_STOP_ACTIVE:
        return State.OPERATION_ENABLED if word & 9 == 9 else state
    # Bit 0, switch on, is 0: shutdown.
    if not word & 1:
        return State.READY
    # Bit 3, enable operation, is 0.
    if not word & 8:
        return state if state is State.SWITCH_ON_DISABLED else State.SWITCHED_ON
    return State.REFRESH if state is State.SWITCHED_ON else state


class EmulatedMotor:
    """Emulated motor; `value(entry)` reads an object of the drive, and `fault(code)` puts the drive
    into fault."""

    def __init__(
        self,
        fin: EmulatedFin,
        units: Units,
        value: Callable[[Object], int],
        fault: Callable[[int], None],
    ) -> None:
        self._fin = fin
        self._units = units
        self._value = value
        self._fault = fault
        self.power_up()

    def power_up(self) -> None:
        """Power up, without a zero."""
        self.mode = protocol.PROFILE_POSITION
        self.referenced = False
        # An incremental encoder starts counting at the power-up position; [counts] from the true
        # zero of the fin.
        self.zero = self._units.counts(self._fin.now().angle)
        self.release()

    def halt(self) -> None:
        """Brake and forget the target."""
        self._fin.halt()
        self._forget()

    def release(self) -> None:
        """Disable the voltage, so that the fin coasts, and forget the target."""
        self._fin.coast()
        self._forget()

    def _forget(self) -> None:
        self._goal: int | None = None
        self.acknowledged = False
        """Bit 12 of the statusword: target acknowledged, or home attained."""

    @property
    def position(self) -> int:
        """Fin position [counts]."""
        return self._units.counts(self._fin.now().angle) - self.zero

    @property
    def demand(self) -> int:
        """Profile position [counts]."""
        return self._units.counts(self._fin.now().demand) - self.zero

    @property
    def rpm(self) -> int:
        """Motor velocity [rpm]."""
        return self._units.direction * round(self._fin.now().velocity * self._units.rpm_per_rad_s)

    @property
    def current(self) -> int:
        """Motor current [mA], positive in the positive direction of the drive."""
        return self._units.direction * round(1000 * self._fin.now().current)

    @property
    def is_target_reached(self) -> bool:
        """Bit 10 of the statusword: the profile is complete or, without a profile, the shaft is at
        rest."""
        return self.rpm == 0 if self._goal is None else self._goal == self.demand

    def control(self, word: int, before: int) -> None:
        """Execute a controlword while operation is enabled."""
        is_new = bool(word & ~before & NEW_TARGET_BIT)
        if self.mode == protocol.HOMING:
            if is_new and self._value(protocol.HOMING_METHOD) == protocol.HOME_HERE:
                self.zero += self.position
                self.referenced = self.acknowledged = True
        elif not word & NEW_TARGET_BIT:
            self.acknowledged = False
        elif is_new and not word & RELATIVE_BIT:
            self.acknowledged = True
            self._goal = goal = self._value(protocol.TARGET)
            if not self._value(protocol.POSITION_MIN) <= goal <= self._value(protocol.POSITION_MAX):
                self._fault(POSITION_LIMIT)
                return
            rpm = min(self._value(protocol.PROFILE_VELOCITY), self._value(protocol.FASTEST))
            self._fin.move(self._units.angle(goal + self.zero), abs(self._units.velocity(rpm)))
