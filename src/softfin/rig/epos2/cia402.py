"""The drive's state machine (CiA 402) with the twelve states of an EPOS2: statusword in, next controlword out; pure.

States and bits: maxon "EPOS2 Firmware Specification" (rel5466) and drivers that were written from it. The generic masks
of CiA 402, as in canopen's `State402`, would read two of the twelve, refresh and measure-init, as "switched on".
"""

from enum import Enum, IntFlag

STATE_MASK = 0x417F
"""Bits of a statusword that make its state."""

SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
QUICK_STOP = 0x0002
DISABLE_VOLTAGE = 0x0000
FAULT_RESET = 0x0080
NEW_TARGET = 0x003F
"""Operation enabled, a new target (bit 4), absolute, at once (bit 5)."""
START_HOMING = 0x001F
RESET_EDGE = (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE)
"""The controlwords that acknowledge a fault: bit 7 must rise, so it is lowered first."""


class State(Enum):
    """State of the drive; the value is the masked statusword."""

    START = 0x0000
    NOT_READY = 0x0100
    SWITCH_ON_DISABLED = 0x0140
    READY = 0x0121
    SWITCHED_ON = 0x0123
    REFRESH = 0x4123
    MEASURE_INIT = 0x4133
    OPERATION_ENABLED = 0x0137
    QUICK_STOP_ACTIVE = 0x0117
    FAULT_REACTION_DISABLED = 0x010F
    FAULT_REACTION_ENABLED = 0x011F
    FAULT = 0x0108

    @property
    def words(self) -> str:
        """Name of the state for messages."""
        return self.name.lower().replace("_", " ")


class Bit(IntFlag):
    """Bits of the statusword beside the state."""

    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    LIMIT = 1 << 11
    ACKNOWLEDGED = 1 << 12
    """The new target was taken; in homing: the home is attained."""
    ERROR = 1 << 13
    """Following error; in homing: homing error."""
    REFERENCED = 1 << 15


FAULTS = frozenset({State.FAULT_REACTION_DISABLED, State.FAULT_REACTION_ENABLED, State.FAULT})
ENABLING = frozenset({State.REFRESH, State.MEASURE_INIT, State.OPERATION_ENABLED})
"""Operation enabled, and the two states through which a drive gets there by itself."""
POWERED = ENABLING | {State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ENABLED}
"""States in which the motor carries current."""
UNPOWERED = frozenset(State) - POWERED

_TO_ENABLED = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}
_STATES = {state.value: state for state in State}


def decode(statusword: int) -> State | None:
    """The state in a statusword; None for one that no EPOS2 sends."""
    return _STATES.get(statusword & STATE_MASK)


def towards_enabled(state: State | None) -> int | None:
    """The controlword that brings a drive one step nearer to operation enabled; None where it moves on by itself.

    A quick stop is first left through disabled voltage: a drive that was stopped is never let go on.
    """
    return _TO_ENABLED.get(state) if state else None
