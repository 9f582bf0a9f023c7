"""The emulated drive by somebody else's client: canopen's own remote node."""

from collections.abc import Iterator

import canopen
import pytest

from softfin.rig.epos2.cia402 import State
from tests.rig.emulation.canopen_bench import PATIENCE_S, CanopenBench, canopen_bench
from tests.rig.epos2_bench import NODE


@pytest.fixture
def bench() -> Iterator[CanopenBench]:
    with canopen_bench() as made:
        yield made


def test_canopens_node_enables_it_by_sdo_and_moves_it(bench: CanopenBench) -> None:
    node, drive, fin = bench.node, bench.drive, bench.fin
    assert node.sdo[0x1000].raw & 0xFFFF == 402
    bench.enable()
    node.sdo[0x6081].raw = 1000
    node.sdo[0x607A].raw = 2000
    node.sdo[0x6040].raw = 0x003F
    assert node.sdo[0x6041].raw & 0x1000
    node.sdo[0x6040].raw = 0x000F
    assert not node.sdo[0x6041].raw & 0x1000
    bench.clock.now += 1.0
    assert node.sdo[0x6064].raw == 2000
    assert fin.now().angle > 0.09
    assert drive.state is State.OPERATION_ENABLED


def test_it_moves_nothing_before_it_is_enabled(bench: CanopenBench) -> None:
    node, fin = bench.node, bench.fin
    bench.until_state(0x140)
    node.sdo[0x607A].raw = 2000
    node.sdo[0x6040].raw = 0x003F
    bench.clock.now += 1.0
    assert fin.now().angle == 0.0


def test_its_emergency_history_and_reset_are_understood(bench: CanopenBench) -> None:
    node, drive = bench.node, bench.drive
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
    assert node.nmt.wait_for_heartbeat(PATIENCE_S) == "PRE-OPERATIONAL"
    node.nmt.state = "OPERATIONAL"
    bench.until(lambda: (0x700 + NODE, b"\x05") in bench.frames)
    node.nmt.state = "RESET"
    bench.until(lambda: (0x700 + NODE, b"\x00") in bench.frames)


def test_canopens_own_process_data_set_it_up_and_read_it(bench: CanopenBench) -> None:
    node, network = bench.node, bench.network
    bench.until_state(0x140)
    node.tpdo[1].cob_id = 0x180 + NODE
    node.tpdo[1].enabled = True
    node.tpdo[1].trans_type = 1
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].add_variable(0x6064)
    node.tpdo[1].save()
    node.nmt.state = "OPERATIONAL"
    network.sync.transmit()
    bench.until(lambda: node.tpdo[1].timestamp is not None)
    assert node.tpdo[1][0].raw & 0x417F == 0x140


def test_a_mapping_is_not_changed_while_its_process_data_are_on(bench: CanopenBench) -> None:
    node = bench.node
    node.sdo[0x1800][1].raw = 0x180 + NODE
    with pytest.raises(canopen.SdoAbortedError, match="08000022"):
        node.sdo[0x1A00][0].raw = 0


@pytest.mark.parametrize("entry", [0x6041, 0x6064, 0x1000])
def test_what_can_only_be_read_is_not_written(bench: CanopenBench, entry: int) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06010002"):
        bench.node.sdo[entry].raw = 1


def test_a_mode_that_it_does_not_have_is_refused(bench: CanopenBench) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06090030"):
        bench.node.sdo[0x6060].raw = 8


def test_a_target_outside_its_limits_is_a_fault_and_no_motion(bench: CanopenBench) -> None:
    node, fin = bench.node, bench.fin
    node.sdo[0x607D][2].raw = 1000
    bench.enable()
    node.sdo[0x607A].raw = 1001
    node.sdo[0x6040].raw = 0x003F
    bench.until_state(0x108)
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0xFF09
    assert fin.now().angle == 0.0


def test_the_states_of_canopens_cia_402_profile_agree_where_it_knows_them(bench: CanopenBench) -> None:
    node = bench.node
    bench.until_state(0x140)
    for word, state, name in (
        (0x06, 0x121, "READY TO SWITCH ON"),
        (0x07, 0x123, "SWITCHED ON"),
        (0x0F, 0x137, "OPERATION ENABLED"),
        (0x02, 0x117, "QUICK STOP ACTIVE"),
        (0x00, 0x140, "SWITCH ON DISABLED"),
    ):
        node.sdo[0x6040].raw = word
        bench.until_state(state)
        node.tpdo_values[0x6041] = node.sdo[0x6041].raw
        assert node.state == name


def test_silent_is_silent_and_a_bus_off_is_a_fault(bench: CanopenBench) -> None:
    node, drive = bench.node, bench.drive
    bench.enable()
    drive.bus_off()
    node.sdo.RESPONSE_TIMEOUT = 0.05
    with pytest.raises(canopen.SdoCommunicationError):
        _ = node.sdo[0x6041].raw
    bench.until(lambda: drive.state is State.FAULT)
