import gc
import math
import threading
import weakref
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import CommandError, DeviceError, SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.rig.machine import Target
from softfin.rig.pace import Pace
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import GOOD_TICKS, Session, mean_force
from softfin.rig.stop import StopRequest
from tests.patience import wait_until
from tests.rig.machines import FreeFin, Hours, Notes

CURRENTS = {"current_peak_a": 4.0, "current_sustained_a": 2.0}


class Made:
    """A session with all that it works with; its clock is the test's."""

    def __init__(self, observers=(), clock=None, **safety) -> None:
        self.hours = clock or Hours()
        self.machine = FreeFin(self.hours)
        self.stop = StopRequest()
        guard = Guard(SafetyConfig.build({**CURRENTS, **safety}, "safety"), self.machine.limits)
        self.session = Session(self.machine, guard, stop=self.stop, observers=observers)
        self.notes = Notes(self.machine)
        self.session.recorder = self.notes

    def moving(self) -> Session:
        """Under way to 1 rad, with the calls so far forgotten."""
        self.session.activate()
        self.session.command(Target(1.0, 2.0))
        for _ in range(5):
            self.session.tick()
        self.machine.calls.clear()
        return self.session

    def check_stopped(self, raised: SafetyStop, cause: str) -> None:
        """Stopped before anything else, told and recorded, and still for good."""
        assert self.machine.calls[0] == "stop"
        after = next(call for call in self.machine.calls if call != "stop")
        assert after.startswith(f"event stopped: {cause}: ")
        assert str(raised).startswith("stopped, motor disabled: ")
        assert "\n" not in str(raised)
        assert raised.exit_code == 3
        assert self.session.state == "stopped"
        assert not self.machine.enabled
        where = self.machine.angle
        self.hours.now += 1.0
        assert self.machine.angle == where
        for try_to_move in (lambda: self.session.command(Target(0.0, 1.0)), self.session.activate):
            with pytest.raises(SafetyStop):
                try_to_move()
        assert "enable" not in self.machine.calls
        assert "command" not in self.machine.calls


def ticks(session: Session) -> None:
    """Two seconds."""
    for _ in range(200):
        session.tick()


def fail_while_moving(made: Made) -> None:
    with made.session:
        made.moving()
        raise KeyError("anything")


def _altered(**changes):
    return lambda made: setattr(made.machine, "altered", lambda sample: sample._replace(**changes))


def _raising(error):
    def fail(sample):
        raise error

    return lambda made: setattr(made.machine, "altered", fail)


def _failed_recording(made):
    made.notes.failure = "run.mcap: recording failed: no space left on device; free disk space"


def _late(made):
    made.hours.now += 0.3


@pytest.mark.parametrize(
    ("provoke", "cause", "words"),
    [
        (
            _altered(complaints=("drive fault 0x8611, following error: check for a blocked fin",)),
            "device",
            "0x8611",
        ),
        (_altered(angle=1.9), "angle", "1.900 rad"),
        (_altered(wrench=(31.0, 0.0, 0.0, 0.0, 0.0, 0.0)), "force_peak", "31.00 N"),
        (_altered(wrench=(16.0, 0.0, 0.0, 0.0, 0.0, 0.0)), "force_sustained", " N on average"),
        (_altered(current=5.0), "current_peak", "5.00 A"),
        (_altered(following_error=0.5), "following", "0.500 rad"),
        (_altered(wrench=(math.nan,) * 6), "reading", "not finite"),
        (_altered(time=100.0), "angle_stale", "no new angle"),
        (
            _raising(DeviceError("drive does not respond; check its supply")),
            "device",
            "does not respond",
        ),
        (_raising(ValueError("two\nlines")), "device", "ValueError: two lines"),
        (_failed_recording, "recording", "no space left on device"),
        (_late, "overrun", "ms late"),
        (
            lambda made: made.stop.ask("emergency_stop", "stopped by a key"),
            "emergency_stop",
            "by a key",
        ),
    ],
)
def test_whatever_is_wrong_stops_the_fin_before_anything_else(provoke, cause, words):
    made = Made(watchdog_s=2.0)
    with made.session as session:
        made.moving()
        provoke(made)
        with pytest.raises(SafetyStop, match=words) as raised:
            ticks(session)
        made.check_stopped(raised.value, cause)
    assert made.machine.calls[-2:] == ["stop", "close"]


@pytest.mark.parametrize(
    ("target", "cause"),
    [
        (Target(math.nan, 1.0), "not_a_number"),
        (Target(0.0, math.inf), "not_a_number"),
        (Target(1.7, 1.0), "command_angle"),
        (Target(0.0, 0.5), "command_velocity"),
        (Target(0.0, 3.5), "command_velocity"),
    ],
)
def test_a_command_that_is_none_stops_the_fin_and_never_reaches_the_drive(target, cause):
    made = Made()
    with made.session as session:
        made.moving()
        with pytest.raises(SafetyStop) as raised:
            session.command(target)
        made.check_stopped(raised.value, cause)


def test_a_drive_that_takes_no_command_stops_the_fin_and_its_fault_is_the_reason():
    made = Made()
    with made.session as session:
        made.moving()
        made.machine.command = _raise(DeviceError("drive is not enabled; enable it first"))
        made.machine.altered = lambda sample: sample._replace(
            complaints=("drive fault 0x3220, under-voltage: look",)
        )
        with pytest.raises(SafetyStop, match="0x3220"):
            session.command(Target(0.0, 1.0))
    made = Made()
    with made.session as session:
        made.moving()
        made.machine.command = _raise(CommandError("angle 1.6 is outside"))
        with pytest.raises(SafetyStop, match=r"angle 1.6 is outside") as raised:
            session.command(Target(0.0, 1.0))
        made.check_stopped(raised.value, "device")


def test_a_drive_that_takes_no_command_is_stopped_before_it_is_read():
    made = Made()
    with made.session as session:
        made.moving()
        made.machine.command = _raise(DeviceError("drive is not enabled; enable it first"))
        read = made.machine.read
        enabled_at_reads = []

        def noted_read():
            enabled_at_reads.append(made.machine.enabled)
            return read()

        made.machine.read = noted_read
        with pytest.raises(SafetyStop, match="not enabled"):
            session.command(Target(0.0, 1.0))
    assert enabled_at_reads == [False]


class Sleeper(Hours):
    """A clock of a computer that sleeps when the test says so."""

    suspended_s = 7.0

    def suspended(self) -> float:
        return self.suspended_s


def test_a_computer_that_was_suspended_while_the_fin_was_active_stops_it():
    made = Made(clock=Sleeper())
    with made.session as session:
        made.moving()
        made.hours.suspended_s += 0.04
        session.tick()
        # Short sleeps add up.
        made.hours.suspended_s += 0.02
        with pytest.raises(SafetyStop, match=r"suspended for 0\.1 s.*systemd-inhibit") as raised:
            session.tick()
        made.check_stopped(raised.value, "suspended")


def test_a_suspend_is_the_reason_in_place_of_the_faults_that_follow_from_it():
    made = Made(clock=Sleeper())
    with made.session as session:
        made.moving()
        made.hours.suspended_s += 60.0
        made.machine.altered = lambda sample: sample._replace(
            complaints=("drive fault 0x8130, heartbeat lost",)
        )
        with pytest.raises(SafetyStop, match="suspended for 60"):
            session.tick()


def test_a_computer_may_sleep_while_nothing_can_move():
    made = Made(clock=Sleeper())
    with made.session as session:
        session.tick()
        made.hours.suspended_s += 3600.0
        made.moving()
        session.deactivate()
        made.hours.suspended_s += 3600.0
        made.moving()
    assert made.session.trip is None


def test_an_observer_that_raises_stops_the_fin():
    failing = threading.Event()

    def observe(sample, target):
        if failing.is_set():
            raise RuntimeError("no such topic")

    made = Made(observers=[observe])
    with made.session as session:
        made.moving()
        failing.set()
        with pytest.raises(SafetyStop, match="RuntimeError: no such topic") as raised:
            session.tick()
        made.check_stopped(raised.value, "observer")


def test_an_observer_sees_each_reading_with_the_command_that_led_to_it():
    seen = []
    made = Made(observers=[lambda sample, target: seen.append(target)])
    with made.session as session:
        session.tick()
        session.activate()
        session.hold(Target(0.3, 1.0), 3)
    assert seen[0] is None
    assert seen[-3:] == [Target(0.3, 1.0)] * 3


def test_nothing_moves_in_any_state_but_active():
    made = Made()
    session = made.session
    machine = made.machine
    with pytest.raises(SafetyStop, match="unconfigured"):
        session.command(Target(0.5, 1.0))
    with pytest.raises(SafetyStop, match="unconfigured"):
        session.activate()
    assert "enable" not in machine.calls
    with session:
        assert session.state == "inactive"
        for _ in range(10):
            session.tick()
        with pytest.raises(SafetyStop, match="inactive"):
            session.command(Target(0.5, 1.0))
        assert machine.angle == 0.0
        assert machine.commands == []
        session.activate()
        assert session.state == "active"
        with pytest.raises(SafetyStop, match="active"):
            session.activate()
        session.hold(Target(0.5, 1.0), 10)
        assert machine.angle > 0.05
        session.deactivate()
        assert session.state == "inactive"
        where = machine.angle
        with pytest.raises(SafetyStop, match="inactive"):
            session.command(Target(0.0, 1.0))
        for _ in range(10):
            session.tick()
        assert machine.angle == where
        session.activate()
        session.hold(Target(0.0, 1.0), 100)
        assert machine.angle == 0.0
    assert session.state == "stopped"
    for try_to_move in (lambda: session.command(Target(0.5, 1.0)), session.activate):
        with pytest.raises(SafetyStop, match="stopped"):
            try_to_move()
    assert not machine.enabled


def test_the_drive_is_not_enabled_before_all_is_well():
    made = Made()
    made.machine.altered = lambda sample: sample._replace(wrench=(40.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with made.session as session:
        with pytest.raises(SafetyStop, match=r"force 40\.00 N"):
            session.activate()
        assert "enable" not in made.machine.calls


def test_what_was_stale_before_activation_may_become_fresh():
    made = Made()
    stale = made.hours.now + 0.3
    made.machine.altered = lambda sample: (
        sample if made.hours.now > stale else sample._replace(force_time=99.0)
    )
    with made.session as session:
        session.activate()
        assert session.state == "active"
        assert 0.29 < made.hours.now - 100 < 0.5


def test_one_slow_tick_before_activation_is_not_the_last_look():
    made = Made()
    began = made.hours.now

    def slow_once(sample):
        if made.hours.now < began + 1.0:
            made.hours.now += 2.0
        return sample

    made.machine.altered = slow_once
    with made.session as session:
        session.activate()
        assert session.state == "active"


def test_a_stop_at_the_last_tick_before_activation_keeps_the_motor_off():
    asked = count()
    made = Made()

    def stop_at_the_tenth(sample, target):
        if next(asked) == GOOD_TICKS - 1:
            made.stop.ask("emergency_stop", "stopped by a person")

    made.session.observers = (stop_at_the_tenth,)
    with pytest.raises(SafetyStop, match="stopped by a person"), made.session:
        made.session.activate()
    assert next(asked) == GOOD_TICKS
    assert "enable" not in made.machine.calls


def test_the_first_command_is_to_stay_where_it_is():
    made = Made()
    made.machine.turn(0.7)
    with made.session as session:
        session.activate()
        assert made.machine.commands == [Target(0.7, made.machine.limits.velocity_min)]


def test_a_fin_that_does_not_enable_is_stopped_and_the_session_stays_inactive():
    made = Made()
    made.machine.enable = _raise(DeviceError("drive stays switched on; check its supply"))
    with made.session as session:
        with pytest.raises(DeviceError, match="stays switched on"):
            session.activate()
        assert session.state == "inactive"
        assert made.machine.commands == []


def test_whatever_ends_the_session_stops_and_closes_the_machine():
    made = Made()
    with pytest.raises(KeyError):
        fail_while_moving(made)
    assert made.machine.calls[0] == "stop"
    assert "event ended by KeyError: 'anything'" in made.machine.calls
    assert made.machine.calls[-1] == "close"


def test_a_persons_stop_is_the_reason_that_is_told_when_much_is_wrong():
    made = Made()
    with made.session as session:
        made.moving()
        made.stop.ask("emergency_stop", "stopped by Ctrl-C")
        made.machine.altered = lambda sample: sample._replace(angle=2.0, complaints=("x",))
        with pytest.raises(SafetyStop, match="Ctrl-C"):
            session.tick()


def test_a_fin_goes_to_rest_slowly_and_one_that_is_held_does_not_come_to_rest():
    made = Made()
    made.machine.turn(1.0)
    with made.session as session:
        session.activate()
        began = made.hours.now
        session.rest(0.5)
        assert made.machine.angle == 0.0
        assert 1.4 < made.hours.now - began < 1.7
        assert made.machine.commands[-1].velocity == made.machine.limits.velocity_min
        made.machine.altered = lambda sample: sample._replace(angle=0.2)
        with pytest.raises(
            SafetyStop, match=r"did not come to rest at angle 0 within 10 s \(it is at 0.200 rad\)"
        ):
            session.rest(0.5)


def test_a_fin_that_may_not_go_to_angle_0_rests_at_the_end_of_its_range():
    made = Made()
    made.machine.limits = made.machine.limits._replace(angle_min=0.4)
    made.machine.turn(1.0)
    with made.session as session:
        session.activate()
        session.rest(0.5)
        assert made.machine.angle == pytest.approx(0.4)
        made.machine.altered = lambda sample: sample._replace(angle=0.6)
        with pytest.raises(SafetyStop, match=r"did not come to rest at angle 0\.4 within 10 s"):
            session.rest(0.5)


def test_at_rest_the_zero_of_the_force_is_measured():
    """Once the water has come to rest: in the second half of the wait."""
    made = Made()
    readings = count(1)
    with made.session as session:
        session.activate()
        made.machine.altered = lambda sample: sample._replace(
            wrench=(0.1 * next(readings), -0.2, 0.0, 0.0, 0.0, 0.0)
        )
        # The first reading shows that the shaft is at rest; of the 20 that follow, the last ten
        # count.
        assert session.rest(0.2) == pytest.approx((0.1 * (12 + 21) / 2, -0.2))


def test_the_mean_force_of_one_sample_is_its_own_and_of_none_zero():
    sample = FreeFin(Hours()).read()._replace(wrench=(2.0, -3.0, 9.0, 9.0, 9.0, 9.0))
    assert mean_force([sample]) == (2.0, -3.0)
    assert mean_force([]) == (0.0, 0.0)


def test_each_reading_is_recorded_once():
    made = Made()
    with made.session as session:
        session.activate()
        newest = made.hours.now + 0.01
        made.machine.altered = lambda sample: sample._replace(
            time=min(sample.time, newest), force_time=sample.time
        )
        made.notes.rows.clear()
        session.hold(Target(0.2, 1.0), 4)
        assert made.notes.rows.count("command") == 1
        assert made.notes.rows.count("joint") <= 2
        assert made.notes.rows.count("wrench") == 4


def test_the_watchdog_stops_a_fin_whose_loop_hangs():
    machine = FreeFin(SimulatedClock())
    session = Session(machine, Guard(SafetyConfig(), machine.limits))
    notes = session.recorder = Notes(machine)
    with session:
        session.activate()
        session.command(Target(1.0, 1.0))
        machine.clock.sleep(1.0)
        # Nobody has called the session since: another thread has stopped it.
        assert not machine.enabled
        assert 0.14 < machine.angle < 0.2
        with pytest.raises(SafetyStop, match=r"loop was silent for 1\d\d ms"):
            session.tick()
    assert sum("stopped: watchdog" in event for event in notes.events) == 1


def test_the_watchdog_sleeps_while_nothing_may_move():
    machine = FreeFin(SimulatedClock())
    with Session(machine, Guard(SafetyConfig(), machine.limits)) as session:
        session.activate()
        session.deactivate()
        machine.clock.sleep(0.5)
        session.tick()
        assert session.state == "inactive"
        assert session.trip is None


def test_a_guard_begins_anew_with_each_activation():
    made = Made(following_s=0.1)
    with made.session as session:
        session.activate()
        made.machine.altered = lambda sample: sample._replace(following_error=0.5)
        for _ in range(8):
            session.tick()
        # Behind its profile for 80 ms, then without power for less than any pause that the guard
        # would notice itself.
        session.deactivate()
        made.hours.now += 0.3
        session.activate()
        for _ in range(8):
            session.tick()
        with pytest.raises(SafetyStop, match="behind its profile"):
            ticks(session)


def test_what_is_read_while_the_drive_is_being_enabled_is_not_held_against_it():
    made = Made(following_s=0.1)
    enable = made.machine.enable

    def slowly() -> None:
        made.hours.now += 0.5
        enable()

    made.machine.enable = slowly
    made.machine.altered = lambda sample: sample._replace(following_error=0.5)
    with made.session as session:
        session.activate()
        session.tick()
        assert session.state == "active"


def test_threads_end_with_the_session():
    def watchdogs():
        return sum(thread.name == "watchdog" for thread in threading.enumerate())

    made = Made()
    before = watchdogs()
    with made.session as session:
        for _ in range(3):
            session.activate()
            session.deactivate()
    wait_until(lambda: watchdogs() <= before)
    assert watchdogs() == before


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.sampled_from(
            ["tick", "activate", "deactivate", "command", "bad", "fault", "ask", "rest"]
        ),
        max_size=12,
    )
)
def test_whatever_the_order_of_calls_it_moves_only_while_active(calls):
    made = Made()
    session = made.session
    machine = made.machine

    def fault():
        machine.altered = lambda sample: sample._replace(complaints=("drive fault",))

    actions = {
        "tick": session.tick,
        "activate": session.activate,
        "deactivate": session.deactivate,
        "command": lambda: session.command(Target(1.0, 2.0)),
        "bad": lambda: session.command(Target(9.0, 2.0)),
        "fault": fault,
        "ask": lambda: made.stop.ask("emergency_stop", "by a key"),
        "rest": lambda: session.rest(0.02),
    }
    with session:
        for call in calls:
            where = machine.angle
            state = session.state
            commanded = len(machine.commands)
            try:
                actions[call]()
            except SafetyStop:
                assert session.state != "active" or call in ("activate",)
            if state != "active" and call != "activate":
                assert machine.angle == where
                assert len(machine.commands) == commanded
            assert machine.enabled == (session.state == "active")
    assert not machine.enabled


def test_garbage_is_collected_before_the_fin_moves_and_not_while_it_does(monkeypatch):
    monkeypatch.setattr("softfin.rig.session.gc", gc)

    class Ring:
        pass

    garbage = Ring()
    garbage.itself = garbage
    gone = weakref.ref(garbage)
    with Made().session as session:
        del garbage
        session.activate()
        assert gone() is None
        assert gc.get_freeze_count() > 10_000
    assert gc.get_freeze_count() == 0


def test_a_pace_of_real_time_is_the_default():
    machine = FreeFin()
    assert isinstance(Session(machine, Guard(SafetyConfig(), machine.limits)).pace, Pace)


def _raise(error):
    def call(*_):
        raise error

    return call
