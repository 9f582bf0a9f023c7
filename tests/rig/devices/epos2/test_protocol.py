import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.emulation.epos2.motor import BY_ITSELF, next_state
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.protocol import FAULT_STATES, State

GOLDEN = {
    0x0000: State.START,
    0x0100: State.NOT_READY,
    0x0140: State.SWITCH_ON_DISABLED,
    0x0121: State.READY,
    0x0123: State.SWITCHED_ON,
    0x4123: State.REFRESH,
    0x4133: State.MEASURE_INIT,
    0x0137: State.OPERATION_ENABLED,
    0x0117: State.QUICK_STOP_ACTIVE,
    0x010F: State.FAULT_REACTION_DISABLED,
    0x011F: State.FAULT_REACTION_ENABLED,
    0x0108: State.FAULT,
}


@pytest.mark.parametrize("word", GOLDEN)
def test_the_twelve_statuswords_are_the_twelve_states(word: int) -> None:
    assert protocol.decode(word) is GOLDEN[word]


@given(st.sampled_from(sorted(GOLDEN)), st.integers(0, 0xFFFF))
def test_bits_outside_the_mask_do_not_change_the_state(word: int, other: int) -> None:
    assert protocol.decode(word | other & ~0x417F) is GOLDEN[word]


@given(st.integers(0, 0xFFFF))
def test_a_word_is_one_of_the_twelve_or_none(word: int) -> None:
    state = protocol.decode(word)
    assert (state is None) == (word & 0x417F not in GOLDEN)


@pytest.mark.parametrize("start", [state for state in State if state not in FAULT_STATES])
def test_every_state_without_fault_can_be_enabled(start: State) -> None:
    state = start
    word = 0
    for _ in range(20):
        following = protocol.TO_ENABLED.get(state)
        if following is not None:
            state = next_state(state, following, word)
            word = following
        state = BY_ITSELF.get(state, state)
    assert state is State.OPERATION_ENABLED


@pytest.mark.parametrize("state", sorted(FAULT_STATES, key=lambda state: state.value))
def test_a_fault_is_never_left_on_the_way_to_enabled(state: State) -> None:
    assert protocol.TO_ENABLED.get(state) is None
    assert protocol.TO_ENABLED.get(None) is None


def test_a_quick_stop_is_left_only_through_disabled_voltage() -> None:
    assert protocol.TO_ENABLED.get(State.QUICK_STOP_ACTIVE) == protocol.DISABLE_VOLTAGE


def test_a_fault_is_reset_by_a_rising_edge_alone() -> None:
    assert next_state(State.FAULT, 0x80, 0x80) is State.FAULT
    assert next_state(State.FAULT, 0x80, 0x00) is State.SWITCH_ON_DISABLED
    words = protocol.RESET_EDGE
    assert [words[k] & ~words[k - 1] & 0x80 for k in range(1, len(words))].count(0x80) == 1


@given(st.sampled_from([*State]), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_no_single_controlword_enables_from_a_state_without_power(
    state: State, word: int, before: int
) -> None:
    if state not in protocol.POWERED:
        following = next_state(state, word, before)
        assert following is not State.OPERATION_ENABLED
        assert following not in protocol.POWERED or state is State.SWITCHED_ON


@given(st.sampled_from([*State]), st.integers(0, 0xFFFF))
def test_quick_stop_and_disabled_voltage_lead_out_of_motion_from_any_state(
    state: State, before: int
) -> None:
    assert next_state(state, protocol.QUICK_STOP, before) not in protocol.ENABLING
    assert next_state(state, protocol.DISABLE_VOLTAGE, before) not in protocol.ENABLING | {
        State.QUICK_STOP_ACTIVE
    }


@pytest.mark.parametrize(
    ("code", "is_value"),
    [
        (0x0609002F, False),
        (0x06090030, True),
        (0x06090031, True),
        (0x06090036, True),
        (0x06090037, False),
    ],
)
def test_a_value_that_the_drive_refuses_is_to_be_changed_in_the_rigs_file(
    code: int, is_value: bool
) -> None:
    assert ("use a value in the rig file" in protocol.abort_line(code)) == is_value


def test_only_a_host_sends_its_heartbeat_and_its_sync() -> None:
    assert protocol.host_cob_ids(126) == {0x77E, 0xFE}
