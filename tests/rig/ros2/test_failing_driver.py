"""Drivers that fail, behind topics in memory, in simulated time: the fin must stop in time, or be
told to turn on."""

import itertools

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.rig.machine import Machine, Target
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.ros2.plant import Ros2Machine
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from softfin.rig.stop import StopRequest
from tests.rig.conformance import check_machine
from tests.rig.ros2.test_plant import CONFIG
from tests.rig.ros2_memory import MemoryTransport, TopicDriver

NEVER_CONFIRMED = (
    "softfin cannot confirm that the motor is off; keep a switch for its supply within reach"
)
STILL_TURNS = "the fin is still turning; switch off its supply"


class Tail:
    """A machine of topics, its driver, and a session with it."""

    def __init__(self, stop_topic="/stop", **driver):
        self.clock = SimulatedClock()
        self.transport = MemoryTransport(self.clock)
        self.driver = TopicDriver(self.clock, self.transport, **driver)
        config = Ros2PlantConfig.build(
            CONFIG | {"frame": "x,y", "wait_s": 1.0, "stop_topic": stop_topic}
        )
        self.machine = Ros2Machine(config, self.clock, lambda config, types: self.transport)
        self.request = StopRequest()
        self.session = Session(
            self.machine, Guard(SafetyConfig(), self.machine.limits), stop=self.request
        )
        self.failed_at = None

    def swim(self, fail, ticks=400):
        """Stroke between -1.4 and 1.4 rad at 3 rad/s; after 1 s something fails. Returns the reason
        of the stop."""
        with pytest.raises(SafetyStop) as stop:
            self._swim(fail, ticks)
        return str(stop.value)

    def _swim(self, fail, ticks):
        with self.session as session:
            session.activate()
            for tick in range(ticks):
                if tick == 100:
                    fail()
                    self.failed_at = self.clock()
                if tick % 33 == 0:
                    session.command(Target(1.4 if tick // 33 % 2 else -1.4, 3.0))
                session.tick()
            self.request.ask("emergency_stop", "nothing was noticed")
            session.tick()

    def noticed_after(self):
        """Time from the failure to the first `true` on the stop topic [s]."""
        return (
            next(at for at in self.transport.sent_at["/stop"] if at >= self.failed_at)
            - self.failed_at
        )


def test_a_machine_of_topics_meets_the_contract():
    tail = Tail(stop_topic=None)
    assert isinstance(tail.machine, Machine)
    check_machine(tail.machine)


@pytest.mark.parametrize(("delay_s", "acceleration"), [(0.0, 150.0), (0.02, 100.0), (0.06, 60.0)])
def test_a_driver_that_follows_late_and_on_ramps_is_no_following_error(delay_s, acceleration):
    tail = Tail(delay_s=delay_s, acceleration=acceleration)
    reason = tail.swim(lambda: None)
    assert reason == f"stopped: nothing was noticed; BUT {NEVER_CONFIRMED}"
    assert abs(tail.driver.velocity) < 1e-9


def test_a_driver_that_takes_commands_no_more_is_stopped_by_its_stop_topic():
    tail = Tail()
    reason = tail.swim(lambda: setattr(tail.driver, "takes_commands", False))
    assert "behind its profile" in reason
    # A stroke of 1 rad passes until the set-point has left the fin by 0.2 rad and the 0.15 s of the
    # driver's delay.
    assert tail.noticed_after() < 0.33 + 0.15 + 0.2 / 3 + 0.1 + 0.02
    assert reason.endswith(f"BUT {NEVER_CONFIRMED}")


def test_a_blocked_fin_is_noticed():
    tail = Tail()
    reason = tail.swim(lambda: setattr(tail.driver, "is_blocked", True))
    assert "behind its profile" in reason
    assert tail.noticed_after() < 0.15 + 0.2 / 3 + 0.1 + 0.33


def test_a_driver_that_vanishes_is_noticed_at_once_and_nobody_says_that_the_fin_stands():
    tail = Tail()
    reason = tail.swim(lambda: setattr(tail.driver, "is_there", False))
    assert tail.noticed_after() < 0.1
    assert reason.startswith("stopped: no new angle for ")
    assert reason.endswith(
        "BUT no new /joint, so the fin may still be turning; switch off its supply"
    )


def test_commands_that_nobody_reads_any_more_are_noticed_at_the_next_tick():
    tail = Tail()
    reason = tail.swim(lambda: tail.transport.readers.update({"/command": 0}))
    assert tail.noticed_after() < 0.03
    assert reason.startswith(
        "stopped: /command no longer has a subscriber, so commands are lost; restart the driver"
    )


def test_a_driver_that_ignores_the_stop_topic_holds_though_somebody_else_reads_it():
    tail = Tail()
    tail.driver.takes_stops = False
    reason = tail.swim(lambda: tail.request.ask("emergency_stop", "a person"))
    assert reason == f"stopped: a person; BUT {NEVER_CONFIRMED}"
    assert tail.driver.velocity == pytest.approx(0.0, abs=1e-6)
    assert abs(tail.driver.angle) < 1.3, "it did not go on to its target"


def test_a_driver_that_hears_nothing_any_more_is_said_to_turn_on():
    tail = Tail()

    def go_deaf():
        tail.driver.takes_commands = tail.driver.takes_stops = False
        tail.driver.target = 1e6
        tail.driver.speed = 1.0
        tail.request.ask("emergency_stop", "a person")

    reason = tail.swim(go_deaf)
    assert reason == f"stopped: a person; BUT {STILL_TURNS}"


def test_a_stop_sends_at_once_again_and_again_and_ends_with_the_rest_of_the_fin():
    tail = Tail()
    machine = tail.machine
    machine.open()
    machine.enable()
    machine.command(Target(1.4, 3.0))
    for _ in range(20):
        tail.clock.sleep(0.01)
        machine.read()
    before = tail.clock()
    commanded = len(tail.transport.sent_at["/command"])
    machine.stop()
    took_s = tail.clock() - before
    for times in (tail.transport.sent_at["/command"][commanded:], tail.transport.sent_at["/stop"]):
        assert times[0] == before
        assert len(times) == pytest.approx(took_s / 0.02, abs=1.1)
    assert 0.1 < took_s < 0.3
    assert machine.stop_unconfirmed == NEVER_CONFIRMED
    machine.stop()
    assert tail.transport.sent_at["/stop"][-1] > before + took_s, "a further call repeats it"


def test_a_stop_is_bounded_in_time_whatever_hangs():
    for hanging in ("commands", "stops", "readings", "all"):
        tail = Tail()
        machine = tail.machine
        machine.open()
        machine.enable()
        machine.command(Target(1.4, 3.0))
        forever = tail.clock.event()
        topics = machine._topics
        if hanging in ("commands", "all"):
            topics.commands.publisher.send = lambda data, event=forever: event.wait()
        if hanging in ("stops", "all"):
            topics.stop.send = lambda data, event=forever: event.wait()
        if hanging in ("readings", "all"):
            topics.joint._subscriber.take = lambda event=forever: event.wait() or []
        before = tail.clock()
        machine.stop()
        assert tail.clock() - before < 0.55
        tail.clock.sleep(0.5)
        if hanging != "all":
            assert abs(tail.driver.velocity) < 1e-6
        is_seen = hanging in ("commands", "stops")
        assert (
            "cannot confirm that the motor" if is_seen else "no new /joint,"
        ) in machine.stop_unconfirmed


def test_a_computer_that_cannot_start_a_thread_sends_the_stop_all_the_same():
    tail = Tail()
    tail.machine.open()
    tail.machine.enable()

    def fail(target, name):
        raise RuntimeError("can't start new thread")

    tail.clock.spawn = fail
    sent = len(tail.transport.sent["/command"])
    tail.machine.stop()
    assert tail.transport.sent["/stop"][-1].data
    assert len(tail.transport.sent["/command"]) > sent


def test_a_stop_that_failed_is_over_with_the_next_opening():
    tail = Tail()
    tail.swim(lambda: setattr(tail.driver, "is_there", False))
    assert "no new /joint, so the fin" in tail.machine.stop_unconfirmed
    tail.driver.is_there = True
    tail.machine.open()
    assert tail.machine.stop_unconfirmed == NEVER_CONFIRMED


def test_commands_are_repeated_twenty_times_a_second_at_rest_too_and_end_with_the_motion():
    tail = Tail(dead_man_s=0.2)
    with tail.session as session:
        session.activate()
        session.rest(2.0)
        session.deactivate()
        times = list(tail.transport.sent_at["/command"])
        assert all(after - before <= 0.061 for before, after in itertools.pairwise(times))
        for _ in range(50):
            session.tick()
        assert tail.transport.sent_at["/command"] == times
    assert tail.transport.deadlines["/command"] == 0.2


def test_a_driver_with_a_dead_mans_switch_stops_where_softfin_is_gone():
    tail = Tail(dead_man_s=0.2)
    machine = tail.machine
    machine.open()
    machine.enable()
    machine.command(Target(1.4, 1.0))
    for _ in range(30):
        tail.clock.sleep(0.01)
        machine.read()
    angle = tail.driver.angle
    assert 0.1 < angle < 0.5
    # From here on softfin is dead.
    tail.clock.sleep(0.3)
    assert tail.driver.velocity == 0.0
    assert tail.driver.angle < angle + 0.3
