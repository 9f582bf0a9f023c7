import itertools

import pytest

from softfin.core.errors import DeviceError, RigError, SafetyStop
from softfin.rig.computer import COMPUTER
from softfin.rig.config import load_rig
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.machine import Machine, Target
from softfin.rig.rig import zero_angle, zero_force
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from softfin.stages.machines import find_rig
from tests.rig.conformance import check_machine
from tests.rig.rigs import config_of, emulated, filed, simulated


def ticks(machine, count):
    samples = []
    for _ in range(count):
        machine.clock.sleep(0.01)
        samples.append(machine.read())
    return samples


def test_a_rig_meets_the_machine_contract():
    with emulated() as (behind, robot):
        assert isinstance(robot.machine, Machine)
        check_machine(robot.machine)
        assert behind.drive.state is State.SWITCH_ON_DISABLED


def test_angle_and_force_are_of_one_fin_in_softfins_axes():
    with emulated() as (_, robot):
        machine = robot.machine
        machine.open()
        machine.enable()
        machine.command(Target(1.2, 1.0))
        samples = ticks(machine, 70)
        machine.close()
    # The fin's force is -0.5 N s/rad times its velocity along x; the filter overshoots a little.
    assert min(sample.wrench[0] for sample in samples) == pytest.approx(-0.5, abs=0.1)
    assert all(abs(sample.wrench[1]) < 1e-3 for sample in samples)
    assert samples[-1].angle > 0.3
    assert all(0.03 < sample.time - sample.force_time < 0.045 for sample in samples)


def test_a_device_that_does_not_answer_leaves_nothing_open():
    with emulated() as (behind, robot):
        behind.sensor.close()
        with pytest.raises(DeviceError, match="force sensor"):
            robot.machine.open()
        with pytest.raises(DeviceError, match="is closed; open the drive first"):
            robot.machine.drive.connection.send(0x80, b"")
        behind.drive.close()
        with pytest.raises(RigError, match="no drive responds"):
            robot.machine.open()


def test_a_fault_stops_the_fin_before_the_loop_looks():
    with emulated() as (behind, robot):
        machine = robot.machine
        machine.open()
        machine.enable()
        machine.command(Target(1.2, 1.0))
        ticks(machine, 20)
        behind.drive.fault(0x8611)
        machine.clock.sleep(0.001)
        with pytest.raises(DeviceError, match="not enabled"):
            machine.command(Target(0.0, 1.0))
        assert any("0x8611" in line for line in machine.read().complaints)
        machine.close()


def test_one_heartbeat_is_sent_every_four_ticks(monkeypatch):
    with emulated() as (_, robot):
        machine = robot.machine
        machine.open()
        beats = []
        monkeypatch.setattr(machine.drive, "send_heartbeat", lambda: beats.append(machine.clock()))
        ticks(machine, 40)
        assert len(beats) == 10
        machine.close()


def test_a_rig_has_the_clock_of_its_emulation_or_the_real_one(tmp_path):
    with simulated() as behind:
        config = config_of(behind)
        assert find_rig(config).clock is COMPUTER
        with filed(behind, tmp_path / "rig.yaml") as file:
            emulated_config = load_rig(file)
            assert find_rig(emulated_config).clock is behind.clock


def test_counters_are_whole_numbers_by_name_after_close_too():
    with emulated() as (_, robot):
        robot.machine.open()
        ticks(robot.machine, 5)
        counters = robot.machine.counters()
        assert counters["sensor_records"] > 0
        assert all(name.isidentifier() for name in counters)
        robot.machine.close()
        assert all(isinstance(count, int) for count in robot.machine.counters().values())


def test_the_force_at_rest_becomes_zero():
    with emulated() as (behind, robot):
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(0.4, -1.5, 0.2, 0.0, 0.0, 0.0)
        )
        told = zero_force(robot.machine, seconds=0.3)
    assert told["force_before_n"] == pytest.approx([0.4, -1.5, 0.2], abs=1e-3)
    assert told["force_after_n"] == pytest.approx([0, 0, 0], abs=1e-3)


def test_a_fin_that_is_moved_is_not_zeroed():
    with emulated() as (behind, robot):
        signs = itertools.cycle((1.0, -1.0))
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(next(signs), 0.0, 0.0, 0.0, 0.0, 0.0)
        )
        with pytest.raises(
            DeviceError,
            match=r"force varies by .* N, but at most 0.3 N is allowed; wait until the water is calm",
        ):
            zero_force(robot.machine, seconds=0.3)


def test_the_angle_where_it_stands_becomes_zero_and_the_fin_does_not_move():
    with emulated() as (behind, robot):
        behind.fin.move(0.3, 100.0)
        told = zero_angle(robot.machine)
        assert told["angle_before_rad"] == pytest.approx(0.3, abs=1e-3)
        assert told["angle_after_rad"] == pytest.approx(0.0, abs=1e-3)
        assert behind.fin.now().angle == pytest.approx(0.3)


def test_a_stop_over_a_cut_cable_does_not_claim_that_the_motor_is_off():
    with emulated() as (behind, robot):
        guard = Guard(robot.safety, robot.machine.limits)
        with Session(robot.machine, guard) as session:
            session.activate()
            behind.drive.go_silent()
            session.stop_request.ask("emergency_stop", "stopped by a key")
            with pytest.raises(SafetyStop) as stopped:
                session.tick()
    assert str(stopped.value).startswith(
        "stopped: stopped by a key; BUT drive did not confirm that its motor is off"
    )
    assert stopped.value.exit_code == 3
