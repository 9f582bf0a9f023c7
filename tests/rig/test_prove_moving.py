"""The trial of a drive's own stop in motion, with each type of drive: in simulated time, and with a
program that is killed and suspended."""

import math
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import yaml

from softfin.core.clock import Clock
from softfin.core.dynamixel import TICKS_PER_TURN
from softfin.core.errors import ConfigurationError, DeviceError, RigError, SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.dynamixel import EmulatedServo
from softfin.emulation.epos2.drive import DriveTraits
from softfin.emulation.rig import EmulatedRig, rigs
from softfin.rig.check import check_rig
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.devices.dynamixel.protocol import HOMING_OFFSET, TORQUE_ENABLE
from softfin.rig.devices.epos2.protocol import UNPOWERED
from softfin.rig.prove import check_proof, prove_stop
from softfin.rig.prove_moving import LEFT_RAD, SWING_RAD, WAY_RAD, prove_moving
from softfin.rig.record import MovingProof, load_record
from softfin.rig.rig import Rig
from softfin.stages.machines import find_rig
from tests.patience import HANG_S, wait_until
from tests.rig.rigs import SAFETY, WIDE, patient, unshared_loopback
from tests.rig.simple_fin import SimpleFin

DRIVES = ("epos2", "dynamixel")

LATE_ATTEMPTS = 5
"""Number of attempts with an emulated servo in real time; on a busy computer, it answers too
late."""


class WatchedFin(SimpleFin):
    """Remembers how far it has been."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.farthest_rad = 0.0

    def now(self):
        motion = super().now()
        self.farthest_rad = max(self.farthest_rad, abs(motion.angle))
        return motion


@contextmanager
def proved(folder: Path, drive: str, clock: Clock) -> Iterator[tuple[EmulatedRig, RigConfig]]:
    """An emulated rig and its file, proved at rest."""
    file = folder / "rig.yaml"
    with EmulatedRig(fin=WatchedFin(clock), clock=clock, drive=drive) as behind:
        values = behind.values(safety=SAFETY | ({} if clock.is_simulated else WIDE), settle_s=0.1)
        if clock.is_simulated:
            values["emulation"] = {}
            rigs[file.resolve()] = behind
        else:
            values["drive"] |= {"heartbeat_s": 0.8}
        file.write_text(yaml.safe_dump(values))
        config = load_rig(file)
        try:
            rig = find_rig(config)
            try:
                rig.drive.open()
                if not config.drive.ZERO_POWERS_MOTOR:
                    rig.drive.zero()
                prove_stop(config, rig.drive)
                rig.drive.close()
                if config.drive.ZERO_POWERS_MOTOR:
                    rig.drive.open()
                    rig.drive.zero()
            finally:
                rig.close()
            yield behind, config
        finally:
            rigs.pop(file.resolve(), None)


@pytest.fixture(params=DRIVES)
def simulated(request, tmp_path):
    with proved(tmp_path, request.param, SimulatedClock()) as (behind, config):
        yield behind, config


def test_a_good_drive_stops_the_fin_within_the_swing_and_check_says_so(simulated, tmp_path):
    behind, config = simulated
    told = []
    proof = prove_moving(find_rig(config), deaths=2, tell=told.append)
    moving = proof.moving
    assert moving.deaths == 4
    assert [line.split(":")[0] for line in told] == ["SIGKILL", "SIGSTOP"] * 2
    assert 0.0 < moving.way_median_rad <= moving.way_worst_rad <= WAY_RAD
    assert behind.fin.farthest_rad < SWING_RAD + LEFT_RAD
    assert load_record(config.file).stop_proof == proof
    (line,) = (
        row for row in check_rig(find_rig(config), tmp_path, 0.1) if row.what == "stop in motion"
    )
    assert (line.state, line.text) == ("well", moving.text)


def test_a_proof_without_motion_is_a_note(simulated, tmp_path):
    _, config = simulated
    (line,) = (
        row for row in check_rig(find_rig(config), tmp_path, 0.1) if row.what == "stop in motion"
    )
    assert line.state == "note"
    assert line.text.endswith("--prove --moving --arm")


def test_what_voids_the_proof_voids_the_trial(simulated):
    behind, config = simulated
    prove_moving(find_rig(config), deaths=1)
    drive = config.drive.model_copy(update={"heartbeat_s": config.drive.heartbeat_s + 0.1})
    changed = config.model_copy(update={"drive": drive})
    rig = Rig(changed, behind.clock)
    try:
        rig.drive.open()
        with pytest.raises(RigError, match="heartbeat_s was"):
            check_proof(changed, rig.drive)
    finally:
        rig.close()


def ignore_loss(behind: EmulatedRig) -> None:
    """Make an emulated drive go on without its host."""
    behind.drive.is_watchdog_broken = True
    behind.drive._traits = DriveTraits(ignores_heartbeat=True)


def is_off(behind: EmulatedRig) -> bool:
    """Whether an emulated drive's motor is off."""
    if isinstance(behind.drive, EmulatedServo):
        return behind.drive.get(TORQUE_ENABLE) == 0
    return behind.drive.state in UNPOWERED


def test_a_drive_that_ignores_the_loss_fails_and_its_motor_is_switched_off(simulated):
    behind, config = simulated
    ignore_loss(behind)
    with pytest.raises(DeviceError, match="did not react when softfin died"):
        prove_moving(find_rig(config), deaths=1)
    assert load_record(config.file).stop_proof is None
    assert is_off(behind)
    assert behind.fin.farthest_rad < SWING_RAD + LEFT_RAD


def test_a_servo_that_turns_elsewhere_when_it_stops_fails(tmp_path):
    with proved(tmp_path, "dynamixel", SimulatedClock()) as (behind, config):
        # With an offset of 600, the fault turns the fin by 0.92 rad.
        more = 600 - behind.drive.get(HOMING_OFFSET)
        behind.drive.set(HOMING_OFFSET, 600)
        behind.fin.move(-more * 2 * math.pi / TICKS_PER_TURN, 10.0)
        behind.clock.sleep(1.0)
        behind.drive.ignores_offset = True
        with pytest.raises(
            DeviceError, match=r"fin (was still turning|turned) .* after softfin died"
        ):
            prove_moving(find_rig(config), deaths=1)
        assert load_record(config.file).stop_proof is None


def test_an_interruption_stops_the_fin_and_keeps_the_proof(simulated):
    behind, config = simulated

    def interrupt(line):
        raise KeyboardInterrupt

    with pytest.raises(SafetyStop, match="motor disabled: interrupted"):
        prove_moving(find_rig(config), tell=interrupt)
    assert is_off(behind)
    assert load_record(config.file).stop_proof is not None


def test_a_fin_outside_the_swing_does_not_move(simulated):
    behind, config = simulated
    behind.fin.move(-0.6, 1.0)
    behind.clock.sleep(1.0)
    with pytest.raises(SafetyStop, match="outside the swing"):
        prove_moving(find_rig(config))
    assert is_off(behind)


def test_a_small_range_is_refused(simulated):
    _, config = simulated
    drive = config.drive.model_copy(update={"angle_max_rad": 0.2})
    with pytest.raises(ConfigurationError, match="must be able to swing"):
        prove_moving(Rig(config.model_copy(update={"drive": drive})))


@contextmanager
def proved_in_real_time(folder: Path, drive: str) -> Iterator[tuple[EmulatedRig, RigConfig]]:
    """For a program in another process; relaxed for a busy computer."""
    with patient(), unshared_loopback(), proved(folder, drive, COMPUTER) as (behind, config):
        yield behind, config


@pytest.mark.real_time
@pytest.mark.parametrize("drive", DRIVES)
def test_a_program_that_is_killed_or_suspended_leaves_a_fin_at_rest(tmp_path, drive):
    with proved_in_real_time(tmp_path, drive) as (behind, config):
        for _ in range(LATE_ATTEMPTS):
            with suppress(DeviceError):
                moving = prove_moving(find_rig(config), deaths=1).moving
                break
        assert moving.deaths == 2
        assert moving.way_worst_rad > 0.0
        assert behind.fin.farthest_rad < SWING_RAD + LEFT_RAD
        assert is_off(behind)


@pytest.mark.real_time
def test_ctrl_c_in_the_middle_stops_the_fin_and_exits_with_3(tmp_path):
    with proved_in_real_time(tmp_path, "epos2") as (behind, config):
        command = [sys.executable, "-m", "softfin.cli", "rig", "check", "--rig", str(config.file)]
        process = subprocess.Popen([*command, "--prove", "--moving", "--arm", "--yes"])
        try:
            wait_until(
                lambda: behind.fin.farthest_rad > SWING_RAD / 2 or process.poll() is not None
            )
            process.send_signal(signal.SIGINT)
            assert process.wait(HANG_S) == 3
        finally:
            process.kill()
        assert is_off(behind)
        angle = behind.fin.now().angle
        COMPUTER.sleep(0.5)
        assert behind.fin.now().angle == angle


def test_a_proof_of_an_earlier_version_is_read():
    fields = {"deaths": 5, "velocity_rad_s": 1.0, "way_median_rad": 0.1, "way_worst_rad": 0.2}
    assert MovingProof.build(fields | {"rest_median_s": 0.3}) == MovingProof.build(fields)
