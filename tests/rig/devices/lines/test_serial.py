"""The same over a pseudo-terminal and over real sockets, with limits that a busy computer meets."""

import socket
import time

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.lines import EmulatedLines
from softfin.rig import streamed_sensor
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.sensor import lines_sensor
from tests import needs
from tests.patience import HANG_S
from tests.rig.still_fin import StillFin

pytestmark = pytest.mark.real_time


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    monkeypatch.setattr(streamed_sensor, "FIRST_WAIT_S", HANG_S)


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def made(over, **changes):
    if over == "serial":
        needs.module("serial", "pyserial is not installed")
    udp_port = None if over == "serial" else free_port()
    emulated = EmulatedLines(StillFin(2.0, -1.0, 0.0, 0.0, 0.0, 0.0), 80.0, udp_port=udp_port)
    values = {
        "columns": ("count", "force_x", "force_y"),
        "rate_hz": 80.0,
        "filter_delay_s": 0.0,
        "frame": "y,-x",
    }
    return emulated, lines_sensor(LinesConfig.build(values | emulated.address() | changes))


@pytest.mark.parametrize("over", ["serial", "udp"])
def test_forces_arrive_and_a_second_program_is_refused(over):
    emulated, sensor = made(over)
    try:
        sensor.open()
        assert sensor.measured(0.3)[0][:2] == pytest.approx((2.0, -1.0), abs=0.01)
        with pytest.raises((RigError, DeviceError), match=r"in use by another|cannot be opened"):
            lines_sensor(sensor.config).open()
        sensor.close()
        sensor.open()
        assert sensor.read().wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
    finally:
        sensor.close()
        emulated.close()


def test_a_sensor_that_is_unplugged_is_a_fault_and_its_port_is_refused_afterwards():
    emulated, sensor = made("serial")
    try:
        sensor.open()
        emulated.unplug()
        end = time.monotonic() + HANG_S
        while not any("disconnected" in line for line in sensor.complaints()):
            assert time.monotonic() < end
            time.sleep(0.01)
        sensor.close()
        with pytest.raises(
            DeviceError, match=r"serial port .*: cannot be opened .*check the cable"
        ):
            sensor.open()
    finally:
        sensor.close()
        emulated.close()
