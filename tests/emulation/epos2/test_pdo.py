"""Process data as CiA 301 has them: when they are sent and taken, what may be mapped."""

from collections.abc import Iterator

import canopen
import pytest

from tests.rig.devices.epos2.bench import NODE
from tests.rig.devices.epos2.canopen_bench import (
    OPERATIONAL,
    PRE_OPERATIONAL,
    STOPPED,
    CanopenBench,
    canopen_bench,
)

STATUS = 0x60410010
POSITION = 0x60640020
PROFILE_VELOCITY = 0x60810020
TPDO = 0x180 + NODE
RPDO = 0x200 + NODE


@pytest.fixture
def bench() -> Iterator[CanopenBench]:
    with canopen_bench() as made:
        yield made


def refused(bench: CanopenBench, index: int, sub: int, value: int, size: int) -> int:
    """The code of the abort."""
    with pytest.raises(canopen.SdoAbortedError) as raised:
        bench.write(index, sub, value, size)
    code: int = raised.value.code
    return code


def synchronise(bench: CanopenBench, times: int) -> int:
    """So many SYNCs; how many process data came of them."""
    before = bench.count(TPDO)
    for _ in range(times):
        bench.send(0x080)
    bench.read(0x1000)
    return bench.count(TPDO) - before


def test_a_pdo_is_sent_at_every_sync(bench: CanopenBench) -> None:
    bench.map(0x1800, 1, STATUS, POSITION)
    bench.nmt(OPERATIONAL)
    assert synchronise(bench, 6) == 6


def test_a_frame_that_is_too_short_changes_nothing(bench: CanopenBench) -> None:
    bench.map(0x1400, 255, PROFILE_VELOCITY)
    bench.nmt(OPERATIONAL)
    bench.send(RPDO, bytes(3))
    assert bench.read(0x6081) == 1000


@pytest.mark.parametrize("command", [PRE_OPERATIONAL, STOPPED])
def test_there_are_no_process_data_but_in_operational(bench: CanopenBench, command: int) -> None:
    bench.map(0x1400, 255, PROFILE_VELOCITY)
    bench.map(0x1800, 1, STATUS)
    bench.nmt(OPERATIONAL)
    bench.nmt(command)
    bench.send(RPDO, (77).to_bytes(4, "little"))
    bench.send(0x080)
    bench.nmt(PRE_OPERATIONAL)
    assert bench.read(0x6081) == 1000
    assert bench.count(TPDO) == 0


def test_a_frame_with_a_long_identifier_is_another_one(bench: CanopenBench) -> None:
    bench.map(0x1400, 255, PROFILE_VELOCITY)
    bench.nmt(OPERATIONAL)
    bench.send(RPDO, (77).to_bytes(4, "little"), is_extended_id=True)
    assert bench.read(0x6081) == 1000


def test_a_mapping_is_not_changed_while_it_is_on_or_counted(bench: CanopenBench) -> None:
    bench.map(0x1800, 1, STATUS)
    assert refused(bench, 0x1A00, 0, 0, 1) == 0x08000022
    bench.write(0x1800, 1, 1 << 31, 4)
    assert refused(bench, 0x1A00, 1, POSITION, 4) == 0x08000022
