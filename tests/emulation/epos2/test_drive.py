"""The emulated drive by somebody else's client: canopen's own remote node."""

from collections.abc import Iterator

import canopen
import pytest

from softfin.rig.devices.epos2.protocol import State
from tests.patience import HANG_S
from tests.rig.devices.epos2.bench import NODE
from tests.rig.devices.epos2.canopen_bench import CanopenBench, canopen_bench


@pytest.fixture
def bench() -> Iterator[CanopenBench]:
    with canopen_bench() as made:
        yield made


def test_it_moves_nothing_before_it_is_enabled(bench: CanopenBench) -> None:
    node = bench.node
    fin = bench.fin
    bench.until_state(0x140)
    node.sdo[0x607A].raw = 2000
    node.sdo[0x6040].raw = 0x003F
    bench.clock.now += 1.0
    assert fin.now().angle == 0.0


def test_its_emergency_history_and_reset_are_understood(bench: CanopenBench) -> None:
    node = bench.node
    drive = bench.drive
    bench.enable()
    drive.fault(0x8611)
    bench.until(lambda: bool(node.emcy.active))
    assert node.emcy.active[0].code == 0x8611
    bench.until_state(0x108)
    assert node.sdo[0x1001].raw != 0
    assert node.sdo[0x1003][0].raw == 1
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0x8611
    node.sdo[0x6040].raw = 0x00
    node.sdo[0x6040].raw = 0x80
    bench.until_state(0x140)
    assert node.sdo[0x1001].raw == 0


def test_its_boot_up_and_heartbeat_are_understood(bench: CanopenBench) -> None:
    node = bench.node
    node.sdo[0x1017].raw = 20
    assert node.nmt.wait_for_heartbeat(HANG_S) == "PRE-OPERATIONAL"
    node.nmt.state = "OPERATIONAL"
    bench.until(lambda: (0x700 + NODE, b"\x05") in bench.frames)
    node.nmt.state = "RESET"
    bench.until(lambda: (0x700 + NODE, b"\x00") in bench.frames)


def test_a_mode_that_it_does_not_have_is_refused(bench: CanopenBench) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06090030"):
        bench.node.sdo[0x6060].raw = 8


def test_a_target_outside_its_limits_is_a_fault_and_no_motion(bench: CanopenBench) -> None:
    node = bench.node
    fin = bench.fin
    node.sdo[0x607D][2].raw = 1000
    bench.enable()
    node.sdo[0x607A].raw = 1001
    node.sdo[0x6040].raw = 0x003F
    bench.until_state(0x108)
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0xFF09
    assert fin.now().angle == 0.0


def test_a_cut_cable_lets_nothing_through(bench: CanopenBench) -> None:
    bench.enable()
    bench.drive.go_silent()
    bench.node.sdo.RESPONSE_TIMEOUT = 0.05
    with pytest.raises(canopen.SdoCommunicationError):
        _ = bench.node.sdo[0x6041].raw
    assert bench.drive.state is State.OPERATION_ENABLED
