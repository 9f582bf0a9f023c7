"""The emulated drive by somebody else's client: canopen's own remote node, and its CiA 402 profile where that works."""

import time
from collections.abc import Iterator
from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from softfin.rig.cia402 import State
from softfin.rig.emulation.drive import EmulatedDrive
from softfin.rig.emulation.drive_dictionary import dictionary, values
from softfin.rig.emulation.simple import SimpleFin
from tests.rig.epos2_bench import LONG_S, NODE, bus_config, drive_config


@pytest.fixture
def bench() -> Iterator[tuple[Any, Any, EmulatedDrive, SimpleFin]]:
    """A remote node of canopen's, its network, the emulated drive and its fin."""
    bus, config, fin = bus_config(), drive_config(), SimpleFin()
    network: Any = canopen.Network()
    network.NOTIFIER_CYCLE = 0.2
    with EmulatedDrive(bus, config, fin) as drive:
        network.connect(interface=bus.interface, channel=bus.channel)
        node = network.add_node(BaseNode402(NODE, dictionary(values(config))))
        try:
            yield node, network, drive, fin
        finally:
            network.disconnect()


def until(node: Any, words: set[int]) -> None:
    end = time.monotonic() + LONG_S
    while node.sdo[0x6041].raw & 0x417F not in words:
        assert time.monotonic() < end
        time.sleep(0.005)


def enable(node: Any) -> None:
    until(node, {0x140})
    for word, state in ((0x06, 0x121), (0x07, 0x123), (0x0F, 0x137)):
        node.sdo[0x6040].raw = word
        until(node, {state})


def test_canopens_node_enables_it_by_sdo_and_moves_it(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, _, drive, fin = bench
    assert node.sdo[0x1000].raw & 0xFFFF == 402
    enable(node)
    node.sdo[0x6081].raw = 1000
    node.sdo[0x607A].raw = 2000
    node.sdo[0x6040].raw = 0x003F
    assert node.sdo[0x6041].raw & 0x1000
    node.sdo[0x6040].raw = 0x000F
    assert not node.sdo[0x6041].raw & 0x1000
    end = time.monotonic() + LONG_S
    while node.sdo[0x6064].raw != 2000:
        assert time.monotonic() < end
    assert fin.now().angle > 0.09
    assert drive.state is State.OPERATION_ENABLED


def test_it_moves_nothing_before_it_is_enabled(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, _, _, fin = bench
    until(node, {0x140})
    node.sdo[0x607A].raw = 2000
    node.sdo[0x6040].raw = 0x003F
    time.sleep(0.02)
    assert fin.now().angle == 0.0


def test_its_emergency_history_and_reset_are_understood(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, _, drive, _ = bench
    enable(node)
    drive.fault(0x8611)
    end = time.monotonic() + LONG_S
    while not node.emcy.active:
        assert time.monotonic() < end
        time.sleep(0.002)
    assert node.emcy.active[0].code == 0x8611
    until(node, {0x108})
    assert node.sdo[0x1001].raw != 0
    assert node.sdo[0x1003][0].raw == 1
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0x8611
    node.sdo[0x6040].raw = 0x00
    node.sdo[0x6040].raw = 0x80
    until(node, {0x140})
    assert node.sdo[0x1001].raw == 0


def test_its_boot_up_and_heartbeat_are_understood(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, _, _, _ = bench
    node.sdo[0x1017].raw = 20
    assert node.nmt.wait_for_heartbeat(LONG_S) == "PRE-OPERATIONAL"
    node.nmt.state = "OPERATIONAL"
    assert node.nmt.wait_for_heartbeat(LONG_S) == "OPERATIONAL"
    node.nmt.state = "RESET"
    node.nmt.wait_for_bootup(LONG_S)


def test_canopens_own_process_data_set_it_up_and_read_it(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, network, _, _ = bench
    until(node, {0x140})
    node.tpdo[1].cob_id = 0x180 + NODE
    node.tpdo[1].enabled = True
    node.tpdo[1].trans_type = 1
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].add_variable(0x6064)
    node.tpdo[1].save()
    node.nmt.state = "OPERATIONAL"
    network.sync.transmit()
    assert node.tpdo[1].wait_for_reception(LONG_S) is not None
    assert node.tpdo[1][0].raw & 0x417F == 0x140


def test_a_mapping_is_not_changed_while_its_process_data_are_on(
    bench: tuple[Any, Any, EmulatedDrive, SimpleFin],
) -> None:
    node, _, _, _ = bench
    node.sdo[0x1800][1].raw = 0x180 + NODE
    with pytest.raises(canopen.SdoAbortedError, match="08000022"):
        node.sdo[0x1A00][0].raw = 0


@pytest.mark.parametrize("entry", [0x6041, 0x6064, 0x1000])
def test_what_can_only_be_read_is_not_written(bench: tuple[Any, Any, EmulatedDrive, SimpleFin], entry: int) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06010002"):
        bench[0].sdo[entry].raw = 1


def test_a_mode_that_it_does_not_have_is_refused(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    with pytest.raises(canopen.SdoAbortedError, match="06090030"):
        bench[0].sdo[0x6060].raw = 8


def test_a_target_outside_its_limits_is_a_fault_and_no_motion(
    bench: tuple[Any, Any, EmulatedDrive, SimpleFin],
) -> None:
    node, _, _, fin = bench
    node.sdo[0x607D][2].raw = 1000
    enable(node)
    node.sdo[0x607A].raw = 1001
    node.sdo[0x6040].raw = 0x003F
    until(node, {0x108})
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0xFF09
    assert fin.now().angle == 0.0


def test_the_states_of_canopens_cia_402_profile_agree_where_it_knows_them(
    bench: tuple[Any, Any, EmulatedDrive, SimpleFin],
) -> None:
    node, _, _, _ = bench
    until(node, {0x140})
    for word, state, name in (
        (0x06, 0x121, "READY TO SWITCH ON"),
        (0x07, 0x123, "SWITCHED ON"),
        (0x0F, 0x137, "OPERATION ENABLED"),
        (0x02, 0x117, "QUICK STOP ACTIVE"),
        (0x00, 0x140, "SWITCH ON DISABLED"),
    ):
        node.sdo[0x6040].raw = word
        until(node, {state})
        node.tpdo_values[0x6041] = node.sdo[0x6041].raw
        assert node.state == name


def test_silent_is_silent_and_a_bus_off_is_a_fault(bench: tuple[Any, Any, EmulatedDrive, SimpleFin]) -> None:
    node, _, drive, _ = bench
    enable(node)
    drive.bus_off()
    node.sdo.RESPONSE_TIMEOUT = 0.05
    with pytest.raises(canopen.SdoCommunicationError):
        _ = node.sdo[0x6041].raw
    end = time.monotonic() + LONG_S
    while drive.state is not State.FAULT:
        assert time.monotonic() < end
        time.sleep(0.002)
