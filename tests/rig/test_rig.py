import pytest

from softfin.core.errors import DeviceError, RigError, SafetyStop
from softfin.rig.epos2.cia402 import State
from softfin.rig.machine import Machine, Target
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from softfin.testing import check_machine
from tests.rig.rigs import emulated


def ticks(machine, count):
    samples = []
    for _ in range(count):
        machine.clock.sleep(0.01)
        samples.append(machine.read())
    return samples


def test_a_rig_meets_the_machine_contract():
    with emulated() as (behind, bench):
        assert isinstance(bench.machine, Machine)
        check_machine(bench.machine)
        assert behind.drive.state is State.SWITCH_ON_DISABLED


def test_angle_and_force_are_of_one_fin_in_softfins_axes():
    with emulated() as (_, bench):
        machine = bench.machine
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


def test_a_sensor_that_does_not_answer_leaves_nothing_open():
    with emulated() as (behind, bench):
        behind.drive.close()
        with pytest.raises(RigError, match="no drive answers"):
            bench.machine.open()
        assert bench.machine.sensor._socket.closed
        behind.sensor.close()
        with pytest.raises(DeviceError):
            bench.machine.open()


def test_a_fault_stops_the_fin_before_the_loop_looks():
    with emulated() as (behind, bench):
        machine = bench.machine
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


def test_counters_are_whole_numbers_by_name_after_close_too():
    with emulated() as (_, bench):
        bench.machine.open()
        ticks(bench.machine, 5)
        counters = bench.machine.counters()
        assert counters["sensor_records"] > 0
        assert all(name.isidentifier() for name in counters)
        bench.machine.close()
        assert all(isinstance(count, int) for count in bench.machine.counters().values())


def test_a_stop_over_a_cut_cable_does_not_claim_that_the_motor_is_off():
    with emulated() as (behind, bench):
        guard = Guard(bench.safety, bench.machine.limits)
        with Session(bench.machine, guard) as session:
            session.activate()
            behind.drive.go_silent()
            session.stop_request.ask("emergency_stop", "stopped by a key")
            with pytest.raises(SafetyStop) as stopped:
                session.tick()
    assert str(stopped.value).startswith("stopped: stopped by a key; BUT drive did not confirm")
    assert stopped.value.exit_code == 3
