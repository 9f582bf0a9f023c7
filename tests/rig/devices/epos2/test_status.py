import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.devices.epos2.config import Units
from softfin.rig.devices.epos2.exchange import ALL, DriveStatus
from softfin.rig.devices.epos2.protocol import FAULTS, Bit, State, fault_line

NODE = 5
UNITS = Units(1.0, 1.0, 1, 0.0)


def test_process_data_is_decoded_from_golden_bytes() -> None:
    status = DriveStatus(NODE, UNITS)
    status.synchronise(1.5)
    assert status.take(0x185, bytes.fromhex("378718fcffff"), 1.501) is None
    status.take(0x285, bytes.fromhex("6afffffff401"), 1.501)
    assert status.answered != ALL
    status.take(0x385, bytes.fromhex("00010000"), 1.502)
    assert status.answered == ALL
    assert (status.statusword, status.position) == (0x8737, -1000)
    assert (status.velocity, status.current, status.demand) == (-150, 0.5, 256)
    assert status.state is State.OPERATION_ENABLED
    assert status.has(Bit.REFERENCED)
    assert not status.has(Bit.ACKNOWLEDGED)
    assert status.time == 1.5


def test_a_drive_that_turns_the_other_way_has_the_current_of_the_fins_direction() -> None:
    status = DriveStatus(NODE, UNITS._replace(direction=-1))
    status.take(0x285, bytes.fromhex("6afffffff401"), 0.0)
    assert (status.velocity, status.current) == (150, -0.5)


def test_a_new_sync_makes_everything_old_and_counts_what_is_missing() -> None:
    status = DriveStatus(NODE, UNITS)
    status.synchronise(0.5)
    for cob_id, size in ((0x185, 6), (0x285, 6), (0x385, 4)):
        status.take(cob_id, bytes(size), 0.5)
    status.synchronise(1.0)
    status.take(0x185, bytes(6), 1.0)
    status.synchronise(2.0)
    assert status.answered == 0
    assert status.counters == {"syncs without all answers": 1}


def test_an_emergency_is_told_by_name_and_ends_with_its_reset() -> None:
    status = DriveStatus(NODE, UNITS)
    line = status.take(0x085, bytes.fromhex("1186110000000000"), 0.0)
    assert line is not None
    assert "following error" in line
    assert status.fault() == line
    status.take(0x085, bytes.fromhex("3081110000000000"), 0.0)
    assert status.fault() == line
    assert status.take(0x085, bytes(8), 0.0) is None
    assert status.fault() is None


def test_a_fault_in_the_statusword_alone_is_told_once() -> None:
    status = DriveStatus(NODE, UNITS)
    assert status.take(0x185, struct.pack("<Hi", 0x0108, 0), 0.0)
    assert status.take(0x185, struct.pack("<Hi", 0x0108, 0), 0.0) is None
    assert status.fault()


def test_a_boot_up_message_is_told_and_frames_of_other_nodes_change_nothing() -> None:
    status = DriveStatus(NODE, UNITS)
    for function in (0x080, 0x180, 0x280, 0x380, 0x700):
        assert status.take(function + 6, bytes(8), 0.0) is None
    assert (status.statusword, status.nmt, status.emergency) == (None, None, None)
    assert "restarted" in str(status.take(0x705, b"\0", 3.0))
    assert status.rebooted


@pytest.mark.parametrize("function", [0x085, 0x185, 0x285, 0x385, 0x705])
def test_a_frame_of_a_wrong_length_is_counted_and_not_taken(function: int) -> None:
    status = DriveStatus(NODE, UNITS)
    assert status.take(function, b"\1\2\3", 0.0) is None
    assert status.counters == {"malformed frames": 1}
    assert (status.statusword, status.nmt, status.emergency) == (None, None, None)


def feed(status: DriveStatus, *functions: int) -> None:
    for function in functions:
        status.take(function + NODE, bytes(4 if function == 0x380 else 6), 0.0)


def test_the_time_of_the_values_stands_while_any_of_them_is_missing() -> None:
    status = DriveStatus(NODE, UNITS)
    for tick in range(1, 12):
        status.synchronise(tick * 0.01)
        feed(status, 0x180, 0x380, *[0x280] * (tick < 3))
    assert status.time == 0.02
    feed(status, 0x280)
    assert status.time == 0.11


@pytest.mark.parametrize("code", [*FAULTS, 0x1234])
def test_every_fault_has_its_number_a_name_and_a_way_out_in_one_line(code: int) -> None:
    line = fault_line(code)
    assert line.startswith(f"drive fault 0x{code:04X}, ")
    assert ": " in line
    assert "\n" not in line


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_is_taken_or_refused_but_never_an_error(cob_id: int, data: bytes) -> None:
    line = DriveStatus(NODE, UNITS).take(cob_id, data, 0.0)
    assert line is None or "\n" not in line
