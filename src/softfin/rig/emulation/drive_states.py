"""How an emulated EPOS2 goes from state to state: by controlwords, and by itself; pure.

Transitions of CiA 402 with maxon's two states on the way to operation enabled
("EPOS2 Firmware Specification", rel5466).
"""

from softfin.rig.epos2 import cia402
from softfin.rig.epos2.cia402 import FAULTS, State

_BY_ITSELF = {
    State.START: State.NOT_READY,
    State.NOT_READY: State.SWITCH_ON_DISABLED,
    State.REFRESH: State.MEASURE_INIT,
    State.MEASURE_INIT: State.OPERATION_ENABLED,
    State.FAULT_REACTION_DISABLED: State.FAULT,
    State.FAULT_REACTION_ENABLED: State.FAULT,
}
_COMMANDABLE = frozenset(State) - FAULTS - {State.START, State.NOT_READY}
_ON = frozenset({State.REFRESH, State.MEASURE_INIT, State.OPERATION_ENABLED})
_SWITCHED_ON = _ON | {State.SWITCHED_ON}


def by_itself(state: State) -> State:
    """A tick later."""
    return _BY_ITSELF.get(state, state)


def by_controlword(state: State, word: int, before: int) -> State:
    """On a controlword, `before` being the last one."""
    if state is State.FAULT and word & ~before & cia402.FAULT_RESET:
        return State.SWITCH_ON_DISABLED
    if state not in _COMMANDABLE or word & cia402.FAULT_RESET:
        return state
    order = word & 0x000F
    if not order & 2:
        return State.SWITCH_ON_DISABLED
    if not order & 4:
        return State.QUICK_STOP_ACTIVE if state in _ON | {State.QUICK_STOP_ACTIVE} else State.SWITCH_ON_DISABLED
    if not order & 1:
        return state if state is State.QUICK_STOP_ACTIVE else State.READY
    if not order & 8:
        return State.SWITCHED_ON if state in _SWITCHED_ON | {State.READY} else state
    if state is State.SWITCHED_ON:
        return State.REFRESH
    return State.OPERATION_ENABLED if state is State.QUICK_STOP_ACTIVE else state


def to_fault(state: State) -> State:
    """When something goes wrong."""
    return State.FAULT_REACTION_ENABLED if state in cia402.POWERED else State.FAULT_REACTION_DISABLED
