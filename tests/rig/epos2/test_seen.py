import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.seen import ALL, Seen

NODE = 5


def test_process_data_is_decoded_from_golden_bytes() -> None:
    seen = Seen(NODE)
    seen.synchronised(1.5)
    assert seen.take(0x185, bytes.fromhex("378718fcffff"), 1.501) is None
    seen.take(0x285, bytes.fromhex("6afffffff401"), 1.501)
    assert seen.fresh != ALL
    seen.take(0x385, bytes.fromhex("00010000"), 1.502)
    assert seen.fresh == ALL
    assert (seen.statusword, seen.position) == (0x8737, -1000)
    assert (seen.velocity, seen.current, seen.demand) == (-150, 500, 256)
    assert seen.state is State.OPERATION_ENABLED
    assert seen.has(Bit.REFERENCED)
    assert not seen.has(Bit.ACKNOWLEDGED)
    assert seen.position_time == 1.5


def test_a_new_sync_makes_everything_old_and_counts_what_is_missing() -> None:
    seen = Seen(NODE)
    for cob_id, size in ((0x185, 6), (0x285, 6), (0x385, 4)):
        seen.take(cob_id, bytes(size), 0.0)
    seen.synchronised(1.0)
    seen.take(0x185, bytes(6), 1.0)
    seen.take(0x185, bytes(6), 1.0)
    seen.synchronised(2.0)
    assert seen.fresh == 0
    assert seen.counters == {"syncs without all answers": 1, "doubled answers": 1}


def test_an_emergency_is_told_by_name_and_ends_with_its_reset() -> None:
    seen = Seen(NODE)
    line = seen.take(0x085, bytes.fromhex("1186110000000000"), 0.0)
    assert line is not None
    assert "following error" in line
    assert seen.fault() == line
    seen.take(0x085, bytes.fromhex("3081110000000000"), 0.0)
    assert seen.fault() == line
    assert seen.take(0x085, bytes(8), 0.0) is None
    assert seen.fault() is None


def test_a_fault_in_the_statusword_alone_is_told_once() -> None:
    seen = Seen(NODE)
    assert seen.take(0x185, struct.pack("<Hi", 0x0108, 0), 0.0)
    assert seen.take(0x185, struct.pack("<Hi", 0x0108, 0), 0.0) is None
    assert seen.fault()


def test_a_boot_up_message_is_told() -> None:
    seen = Seen(NODE)
    line = seen.take(0x705, b"\0", 3.0)
    assert line is not None
    assert "started anew" in line
    assert seen.rebooted


def test_frames_of_other_nodes_change_nothing() -> None:
    seen = Seen(NODE)
    for function in (0x080, 0x180, 0x280, 0x380, 0x700):
        assert seen.take(function + 6, bytes(8), 0.0) is None
    assert (seen.ever, seen.nmt, seen.emergency) == (0, None, None)


@pytest.mark.parametrize("function", [0x085, 0x185, 0x285, 0x385, 0x705])
def test_a_frame_of_a_wrong_length_is_counted_and_not_taken(function: int) -> None:
    seen = Seen(NODE)
    assert seen.take(function, b"\1\2\3", 0.0) is None
    assert seen.counters == {"malformed frames": 1}
    assert (seen.ever, seen.nmt, seen.emergency) == (0, None, None)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_is_taken_or_refused_but_never_an_error(cob_id: int, data: bytes) -> None:
    line = Seen(NODE).take(cob_id, data, 0.0)
    assert line is None or "\n" not in line
