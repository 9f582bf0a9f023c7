"""The same over a pseudo-terminal, in real time and with ROBOTIS's own library."""

import os
import signal
import subprocess
import sys
import time
from contextlib import closing, contextmanager

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.dynamixel import EmulatedServo
from softfin.rig.computer import COMPUTER
from softfin.rig.devices.dynamixel import drive as driver
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.drive import Dynamixel
from softfin.rig.machine import Target
from tests import needs
from tests.patience import HANG_S, wait_until
from tests.rig.braking_fin import BrakingFin
from tests.rig.devices.dynamixel.bench import QUICK_STOP_RAD_S2, servo_config

needs.module("serial", "pyserial is not installed")

pytestmark = pytest.mark.real_time

SHUTTLE = """
import sys, time
from softfin.rig.devices.dynamixel import drive as driver
from softfin.rig.devices.dynamixel.drive import Dynamixel
from softfin.rig.machine import Target
from tests.rig.devices.dynamixel.bench import servo_config
driver.ANSWER_S = driver.SLOWEST_ANSWER_S = 0.05
drive = Dynamixel(servo_config(port=sys.argv[1], zero_needed=False, angle_max_rad=1.5))
drive.open()
drive.enable()
drive.command(Target(1.5, 1.0))
while True:
    drive.read()
    time.sleep(0.01)
"""
"""A host that turns the fin until it is killed; a busy computer answers late."""


REACTIONS = {
    "ends": "",
    "stops its fin": """
def stop(*_):
    drive.stop()
    sys.exit(3)
signal.signal(signal.SIGTERM, stop)
""",
    "ignores it": "signal.signal(signal.SIGTERM, signal.SIG_IGN)",
}
"""Code that handles SIGTERM in the program that moves the fin."""

SWIMMING = """
import signal, sys, time
from softfin.core.errors import SoftfinError
from softfin.rig.devices.dynamixel import drive as driver
from softfin.rig.devices.dynamixel.drive import Dynamixel
from softfin.rig.machine import Target
from tests.rig.devices.dynamixel.bench import servo_config
driver.ANSWER_S = driver.SLOWEST_ANSWER_S = 0.2
drive = Dynamixel(servo_config(port=sys.argv[1], heartbeat_s=1.0, zero_needed=False))
while True:
    try:
        drive.open()
        break
    except SoftfinError:
        # A busy computer is too slow for the servo's answers.
        time.sleep(0.1)
{reaction}
drive.enable()
for tick in range(10_000):
    if tick % 100 == 0:
        drive.command(Target(1.5 if tick % 200 else -1.5, 1.0))
    drive.read()
    time.sleep(0.01)
    if drive.complaints():
        break
drive.stop()
"""
"""A host that turns the fin back and forth for at most two minutes."""

TRIALS = 50 if os.environ.get("SOFTFIN_LONG") == "1" else 2


@contextmanager
def real_servo(**changes):
    config = servo_config(**changes)
    with closing(EmulatedServo(config, BrakingFin(QUICK_STOP_RAD_S2), COMPUTER)) as servo:
        yield servo


@pytest.fixture
def _patient(monkeypatch):
    monkeypatch.setattr(driver, "ANSWER_S", 0.2)
    monkeypatch.setattr(driver, "SLOWEST_ANSWER_S", 0.2)


@pytest.mark.usefixtures("_patient")
def test_the_fin_moves_and_a_second_program_is_refused():
    with real_servo(heartbeat_s=1.0) as servo:
        drive = Dynamixel(servo_config(heartbeat_s=1.0, **servo.address()))
        try:
            drive.open()
            drive.zero()
            drive.enable()
            with pytest.raises(
                (RigError, DeviceError), match=r"in use by another|cannot be opened"
            ):
                Dynamixel(drive.config).open()
            drive.command(Target(0.5, 1.0))
            wait_until(lambda: abs(drive.read().angle - 0.5) < 0.01)
            drive.stop()
            assert drive.stop_unconfirmed is None
        finally:
            drive.close()


@pytest.mark.usefixtures("_patient")
def test_a_port_that_is_unplugged_is_told_and_its_stop_is_unconfirmed():
    with real_servo(heartbeat_s=1.0) as servo:
        drive = Dynamixel(servo_config(heartbeat_s=1.0, zero_needed=False, **servo.address()))
        try:
            drive.open()
            drive.enable()
            servo.unplug()
            drive.read()
            assert any("port cannot be used" in line for line in drive.complaints())
            drive.stop()
            assert "press the emergency stop" in drive.stop_unconfirmed
            drive.close()
            with pytest.raises(DeviceError, match=r"serial port .*: cannot be opened"):
                drive.open()
        finally:
            drive.close()


@contextmanager
def swimming(port, reaction):
    """A process that moves the fin."""
    script = SWIMMING.format(reaction=REACTIONS[reaction])
    host = subprocess.Popen([sys.executable, "-c", script, port])
    try:
        yield host
    finally:
        host.kill()
        host.wait()


@pytest.mark.parametrize("reaction", REACTIONS)
@pytest.mark.parametrize("_trial", range(TRIALS))
def test_a_fin_driven_by_another_program_is_stopped_and_stays_off(reaction, _trial):
    with real_servo(heartbeat_s=1.0, zero_needed=False) as servo:
        port = servo.address()["port"]
        with swimming(port, reaction) as host:
            wait_until(lambda: servo._fin.now().velocity or host.poll() is not None)
            assert host.poll() is None
            Dynamixel(servo_config(heartbeat_s=1.0, port=port)).switch_off()
            # The motor must stay off, although the other program may still be running.
            end = time.monotonic() + 0.3
            while time.monotonic() < end:
                assert servo.get(protocol.TORQUE_ENABLE) == 0
                time.sleep(0.005)
            wait_until(lambda: servo._fin.now().velocity == 0)
            host.wait(HANG_S)


class Watch:
    """Notes the servo's looks at its bus watchdog, which are late on a busy computer."""

    def __init__(self, servo):
        self.longest_s = 0.0
        self.tripped_after_s = None
        self._latest = None
        self._servo = servo
        self._watch = servo._watch
        servo._watch = self.look

    def look(self, now):
        self._watch(now)
        if self._latest is not None:
            self.longest_s = max(self.longest_s, now - self._latest)
        self._latest = now
        is_tripped = self._servo.get(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED
        if is_tripped and self.tripped_after_s is None:
            self.tripped_after_s = now - self._servo._instruction_time


def died(command, death, servo):
    """Return whether the host has moved the fin before it died by the signal; on a busy computer
    it may be too slow for its own servo's watchdog."""
    host = subprocess.Popen(command)
    try:
        wait_until(
            lambda: (
                servo._fin.now().velocity > 0
                or servo.get(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED
                or host.poll() is not None
            )
        )
        if not servo._fin.now().velocity:
            assert servo.get(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED, "the host ended"
            return False
        host.send_signal(death)
        wait_until(lambda: servo._fin.now().velocity == 0)
        return True
    finally:
        host.kill()
        host.wait()


@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGSTOP])
def test_a_servo_stands_soon_after_its_host_is_killed_or_hangs(death):
    for _ in range(20):
        with real_servo(zero_needed=False, angle_max_rad=1.5) as servo:
            watch = Watch(servo)
            command = [sys.executable, "-c", SHUTTLE, servo.address()["port"]]
            if not died(command, death, servo):
                continue
            assert servo.get(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED
            assert servo._fin.now().angle < 1.4
            # The braking from 1 rad/s follows; together 0.11 s on a computer that is not busy.
            assert 0.08 <= watch.tripped_after_s <= 0.08 + watch.longest_s
            return
    pytest.fail("the computer is too busy to move a servo in real time")


def test_the_emulator_is_understood_by_the_library_of_robotis(monkeypatch):
    sdk = needs.module("dynamixel_sdk", "dynamixel-sdk is not installed")
    with real_servo() as servo:
        port = sdk.PortHandler(servo.address()["port"])
        # The library's own timeout of 34 ms is too short for a busy computer.
        monkeypatch.setattr(
            port, "setPacketTimeout", lambda length: port.setPacketTimeoutMillis(10_000)
        )
        assert port.openPort()
        packets = sdk.PacketHandler(2.0)
        try:
            assert packets.ping(port, 7) == (1020, 0, 0)
            assert packets.read4ByteTxRx(port, 7, 132)[0] == servo.get(protocol.PRESENT_POSITION)
            assert packets.write1ByteTxRx(port, 7, 64, 1) == (0, 0)
            assert servo.get(protocol.TORQUE_ENABLE) == 1
            assert packets.write4ByteTxRx(port, 7, 116, 4095) == (0, 6)
            assert packets.write1ByteTxRx(port, 7, 11, 1) == (0, 7)
            # Data that look like a header.
            assert packets.write4ByteTxRx(port, 7, 104, 0xFDFFFF) == (0, 0)
            assert packets.read4ByteTxRx(port, 7, 104) == (0xFDFFFF, 0, 0)
            assert packets.reboot(port, 7) == (0, 0)
            assert servo.get(protocol.TORQUE_ENABLE) == 0
            group = sdk.GroupSyncRead(port, packets, 144, 2)
            assert group.addParam(7)
            assert group.txRxPacket() == 0
            assert group.getData(7, 144, 2) == 120
        finally:
            port.closePort()
