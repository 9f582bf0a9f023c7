"""A session on the rig after a time in which nobody read its sensor: a person types, a log is
written."""

import math
import os

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation import network as simulated_network
from softfin.emulation.epos2 import motor as emulated_motor
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.machine import Target
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import GOOD_TICKS, Session
from tests.rig.rigs import emulated

BUFFERS_BYTES = [64 * 1024, 4 * 1024 * 1024]
LONG = os.environ.get("SOFTFIN_LONG") == "1"
PAUSES_S = [0.0, 0.55, 3.0, 60.0 if LONG else 12.0]
"""Every buffer is full after 11 s."""


class Moment:
    """The force's age at each time that the motor gets its power."""

    def __init__(self, machine):
        self.ages = []
        self.newest = None
        read = machine.read
        enable = machine.enable

        def read_and_note():
            self.newest = read()
            return self.newest

        def enable_and_note():
            self.ages.append(machine.clock() - self.newest.force_time)
            enable()

        machine.read = read_and_note
        machine.enable = enable_and_note


@pytest.fixture(params=BUFFERS_BYTES)
def bench(request, monkeypatch):
    """An emulated rig whose computer has a buffer of so many bytes; limits are the defaults."""
    monkeypatch.setattr(simulated_network, "RMEM_MAX_BYTES", request.param)
    with emulated() as (behind, robot):
        yield behind, robot.machine, robot.safety


def pause(behind, seconds):
    """Nobody reads; the emulators do their work."""
    behind.clock.sleep(seconds)


@pytest.mark.parametrize("pause_s", PAUSES_S)
def test_after_a_pause_the_motor_is_powered_and_its_force_is_fresh(bench, pause_s):
    behind, machine, safety = bench
    assert safety.force_stale_s == SafetyConfig().force_stale_s
    moment = Moment(machine)
    with Session(machine, Guard(safety, machine.limits)) as session:
        pause(behind, pause_s)
        session.activate()
        session.hold(Target(0.2, 1.0), 20)
        # A log is written, and the next one begins.
        session.deactivate()
        pause(behind, pause_s)
        session.activate()
        session.hold(Target(-0.2, 1.0), 20)
    assert len(moment.ages) == 2
    assert max(moment.ages) <= 0.05


def test_a_force_that_came_up_in_a_pause_is_seen_before_the_motor_is_powered(bench):
    behind, machine, safety = bench
    moment = Moment(machine)
    with Session(machine, Guard(safety, machine.limits)) as session:
        session.tick()
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(60.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        )
        pause(behind, 3.0)
        with pytest.raises(SafetyStop, match=r"force 60\.00 N, but at most 30 N is allowed"):
            session.activate()
    assert moment.ages == []


def test_a_sensor_that_restarted_in_a_pause_is_named_before_the_motor_is_powered(bench):
    behind, machine, safety = bench
    moment = Moment(machine)
    with Session(machine, Guard(safety, machine.limits)) as session:
        pause(behind, 5.0)
        behind.sensor.reboot(2.0)
        pause(behind, 2.3)
        with pytest.raises(
            SafetyStop, match="restarted; check its supply and cable, then start again"
        ):
            session.activate()
    assert moment.ages == []


@pytest.mark.parametrize("enable_s", [0.02, 0.3, 0.7])
def test_a_drive_that_takes_long_to_enable_leaves_the_force_fresh(bench, monkeypatch, enable_s):
    behind, machine, safety = bench
    next_state = emulated_motor.next_state
    began = []

    def slow_next_state(state, word, before):
        after = next_state(state, word, before)
        if after is not State.REFRESH or after is state:
            return after
        began.append(behind.clock())
        return after if began[-1] - began[0] >= enable_s else state

    monkeypatch.setattr(emulated_motor, "next_state", slow_next_state)
    with Session(machine, Guard(safety, machine.limits)) as session:
        pause(behind, 1.0)
        session.activate()
        sample = session.tick()
        assert began[-1] - began[0] >= enable_s
        assert behind.clock() - sample.force_time < 0.05
        session.hold(Target(0.2, 1.0), 20)


def test_a_fault_that_comes_and_goes_never_gets_the_motor_powered():
    with emulated() as (_, robot):
        machine = robot.machine
        moment = Moment(machine)
        read = machine.read
        ticks = []

        def read_with_fault():
            ticks.append(None)
            sample = read()
            return (
                sample._replace(complaints=("it flickers",))
                if len(ticks) % GOOD_TICKS == 0
                else sample
            )

        machine.read = read_with_fault
        with (
            Session(machine, Guard(robot.safety, machine.limits)) as session,
            pytest.raises(SafetyStop, match="it flickers"),
        ):
            session.activate()
        assert moment.ages == []


@pytest.mark.parametrize("lost", [10, 11, 15])
def test_a_dozen_lost_records_do_not_stop_the_fin(lost):
    with emulated() as (behind, robot):
        machine = robot.machine
        with Session(machine, Guard(robot.safety, machine.limits)) as session:
            session.activate()
            session.command(Target(0.5, 1.0))
            for place in range(10):
                left = iter(range(lost))
                behind.sensor.transmit = lambda datagram, left=left: (
                    () if next(left, None) is not None else (datagram,)
                )
                for _ in range(20 + place):
                    session.tick()
            assert machine.counters()["sensor_lost"] == 10 * lost
            assert math.isclose(machine.read().angle, 0.5, abs_tol=0.01)
