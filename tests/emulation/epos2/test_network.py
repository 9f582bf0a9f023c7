"""NMT, the object dictionary and errors of the emulated drive as CiA 301 has them."""

from collections.abc import Iterator

import canopen
import pytest

from tests.rig.devices.epos2.bench import NODE
from tests.rig.devices.epos2.canopen_bench import (
    PRE_OPERATIONAL,
    RESET_NODE,
    STOPPED,
    CanopenBench,
    canopen_bench,
)

HEARTBEAT = 0x700 + NODE
HOST = 0x700 + 127
BOOT_UP = (HEARTBEAT, b"\x00")


@pytest.fixture
def bench() -> Iterator[CanopenBench]:
    with canopen_bench() as made:
        yield made


def test_a_stopped_node_answers_no_sdo_and_sends_no_emergency(bench: CanopenBench) -> None:
    bench.nmt(STOPPED)
    bench.send(0x600 + NODE, bytes.fromhex("4041600000000000"))
    # This SDO comes after the other: the node is stopped no more.
    bench.nmt(PRE_OPERATIONAL)
    bench.read(0x1000)
    assert bench.count(0x580 + NODE) == 1
    bench.nmt(STOPPED)
    bench.until(lambda: bench.drive._node.nmt.state == "STOPPED")
    bench.drive.fault(0x8611)
    bench.nmt(PRE_OPERATIONAL)
    assert bench.read(0x1003, 1) == 0x8611
    assert bench.count(0x080 + NODE) == 0


def test_a_stopped_node_goes_on_with_its_heartbeat(bench: CanopenBench) -> None:
    bench.write(0x1017, 0, 10, 2)
    bench.nmt(STOPPED)
    bench.until(lambda: (HEARTBEAT, b"\x04") in bench.frames)


def test_a_reset_of_the_node_forgets_everything(bench: CanopenBench) -> None:
    bench.enable()
    bench.write(0x6081, 0, 77, 4)
    bench.nmt(RESET_NODE)
    bench.until(lambda: BOOT_UP in bench.frames)
    assert bench.read(0x6081) == 1000
    bench.until_state(0x140)


@pytest.mark.parametrize(("index", "sub", "size"), [(0x1003, 1, 4), (0x6502, 0, 4)])
def test_entries_that_can_only_be_read_are_not_written(
    bench: CanopenBench, index: int, sub: int, size: int
) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06010002"):
        bench.write(index, sub, 0, size)


def test_a_value_of_another_length_and_an_object_that_is_not_there_are_refused(
    bench: CanopenBench,
) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06070010"):
        bench.write(0x6040, 0, 0, 4)
    with pytest.raises(canopen.SdoAbortedError, match="06020000"):
        bench.read(0x2099)
