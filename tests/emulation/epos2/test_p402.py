"""The emulated drive brought up by canopen's own CiA 402 node alone, as its users do it."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from softfin.rig.devices.epos2.protocol import State
from tests.patience import HANG_S
from tests.rig.devices.epos2.canopen_bench import CanopenBench, canopen_bench


@pytest.fixture
def bench() -> Iterator[CanopenBench]:
    with canopen_bench() as made:
        # A busy machine is no fault of the drive.
        for name in (
            "TIMEOUT_SWITCH_STATE_FINAL",
            "TIMEOUT_SWITCH_STATE_SINGLE",
            "TIMEOUT_CHECK_TPDO",
            "TIMEOUT_SWITCH_OP_MODE",
        ):
            setattr(made.node, name, HANG_S)
        yield made
        made.network.sync.stop()


def by_sync(bench: CanopenBench) -> Any:
    """Set up with statusword, mode and position at every SYNC."""
    node = bench.node
    node.nmt.state = "PRE-OPERATIONAL"
    node.tpdo.read()
    node.tpdo[1].clear()
    for index in (0x6041, 0x6061, 0x6064):
        node.tpdo[1].add_variable(index)
    node.tpdo[1].enabled = True
    node.tpdo.save()
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    bench.network.sync.start(0.01)
    # Its first statusword is one that it never received.
    bench.until(lambda: node.state == "SWITCH ON DISABLED")
    return node


def by_sdo(bench: CanopenBench) -> Any:
    """Set up without process data."""
    node = bench.node
    node.nmt.state = "PRE-OPERATIONAL"
    node.setup_402_state_machine()
    bench.until(lambda: node.state == "SWITCH ON DISABLED")
    return node


@pytest.mark.parametrize("set_up", [by_sync, by_sdo])
def test_it_is_brought_up_and_moved_to_a_set_point(
    bench: CanopenBench, set_up: Callable[[CanopenBench], Any]
) -> None:
    node = set_up(bench)
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    assert bench.drive.state is State.OPERATION_ENABLED
    node.sdo[0x6081].raw = 1000
    node.sdo[0x607A].raw = 2000
    node.controlword = 0x1F
    bench.until(lambda: node.sdo[0x6041].raw & 0x1000)
    assert not node.sdo[0x6041].raw & 0x0400
    node.controlword = 0x0F
    bench.until(lambda: not node.sdo[0x6041].raw & 0x1000)
    bench.clock.now += 1.0
    assert node.sdo[0x6041].raw & 0x0400
    assert node.sdo[0x6064].raw == 2000
    node.state = "SWITCH ON DISABLED"
    assert bench.drive.state is State.SWITCH_ON_DISABLED


def test_the_fin_is_homed_by_it(bench: CanopenBench) -> None:
    bench.fin.move(0.5, 1.0)
    bench.clock.now += 1.0
    node = by_sync(bench)
    assert node.sdo[0x6064].raw != 0
    node.sdo[0x6098].raw = 35
    assert node.homing(timeout=HANG_S, restore_op_mode=True)
    assert node.sdo[0x6041].raw & 0x8000
    assert node.sdo[0x6064].raw == 0
