import itertools
import os
import re
import sys
import types

import numpy as np
import pytest

from softfin.core.clock import REAL
from softfin.core.errors import CommandError, ConfigurationError, DeviceError, RigError
from softfin.emulation.clock import SimulatedClock
from softfin.rig.machine import Machine, Target
from softfin.rig.ros2.config import Ros2PlantConfig, TransportConfig
from softfin.rig.ros2.plant import Ros2Machine, open_transport
from tests.rig.ros2_memory import MemoryTransport, Messages

START = 1_700_000_000 * 10**9

CONFIG = {
    "joint_topic": "/joint",
    "joint_name": "fin",
    "wrench_topic": "/wrench",
    "frame": "y,-x",
    "command_topic": "/command",
    "wait_s": 0.05,
    "limits": {
        "angle_min_rad": -1.5,
        "angle_max_rad": 1.5,
        "velocity_min_rad_s": 1.0,
        "velocity_max_rad_s": 3.0,
    },
}

FLIPPER = {
    "type": "own/msg/Flipper",
    "definitions": {
        "own/msg/Flipper": "std_msgs/Header header\nfloat32 amplitude\nfloat32 zero_direction\n"
    },
}


class Rig:
    """A machine on a transport in memory, in simulated time; its driver publishes where the test
    says so."""

    def __init__(self, **changes):
        self.clock = SimulatedClock()
        self.transport = MemoryTransport(self.clock)
        self.machine = Ros2Machine(
            Ros2PlantConfig.build(CONFIG | changes),
            self.clock,
            lambda config, types: self._with(types),
        )
        self.stamp = START
        self.say()

    def _with(self, types):
        self.transport.messages = Messages(types=types)
        return self.transport

    def say(self, angle=0.25, velocity=0.5, wrench=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)):
        self.stamp += 10**7
        messages = self.transport.messages
        self.transport.put("/joint", messages.joint(self.stamp, "", "fin", angle, velocity))
        self.transport.put("/wrench", messages.wrench(self.stamp, "", wrench))

    def commands(self):
        """Commands without their repetitions."""
        sent = [(m.position[0], m.velocity[0]) for m in self.transport.sent["/command"]]
        return [command for command, _ in itertools.groupby(sent)]

    def stops(self):
        """Messages on the stop topic without their repetitions."""
        return [stop for stop, _ in itertools.groupby(m.data for m in self.transport.sent["/stop"])]


@pytest.fixture
def rig():
    made = Rig()
    made.machine.open()
    return made


def test_it_meets_the_contract(rig):
    assert isinstance(rig.machine, Machine)
    assert rig.machine.limits == (-1.5, 1.5, 1.0, 3.0)
    assert rig.machine.notes == ("in memory",)


def test_a_sample_is_the_newest_of_both_topics_in_softfins_axes(rig):
    rig.clock.sleep(0.01)
    rig.say(0.5, 1.5)
    said_at = pytest.approx(rig.clock(), abs=0.003)
    sample = rig.machine.read()
    assert (sample.angle, sample.velocity) == (0.5, 1.5)
    assert sample.wrench == (2.0, -1.0, 3.0, 5.0, -4.0, 6.0)
    assert sample.time == said_at
    assert sample.complaints == ()
    rig.clock.sleep(1.0)
    assert rig.machine.read().time == said_at, "what is old says so"
    assert rig.machine.counters() == {
        "joint_received": 2,
        "joint_refused": 0,
        "joint_not_newer": 0,
        "wrench_received": 2,
        "wrench_refused": 0,
        "wrench_not_newer": 0,
    }


def test_readings_are_asked_for_with_the_quality_that_every_publisher_offers():
    rig = Rig()
    rig.machine.open()
    for topic in ("/joint", "/wrench"):
        assert [asked for _, asked in rig.transport.asked[topic]] == ["best_effort"]


@pytest.mark.parametrize(
    ("transport", "is_installed", "opened"),
    [
        ("auto", False, "dds"),
        ("auto", True, "rclpy"),
        ("dds", True, "dds"),
        ("dds", False, "dds"),
        ("rclpy", True, "rclpy"),
    ],
)
def test_the_transport_is_rclpy_if_it_is_installed_and_not_unwanted(
    monkeypatch, transport, is_installed, opened
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object() if is_installed else None)
    made = {name: MemoryTransport(SimulatedClock()) for name in ("dds", "rclpy")}
    dds = types.SimpleNamespace(DdsTransport=lambda *_: made["dds"])
    rclpy = types.SimpleNamespace(RclpyTransport=lambda *_: made["rclpy"])
    monkeypatch.setitem(sys.modules, "softfin.rig.ros2.dds", dds)
    monkeypatch.setitem(sys.modules, "softfin.rig.ros2.rclpy", rclpy)
    assert open_transport(TransportConfig(transport=transport)) is made[opened]


def test_a_driver_that_counts_the_other_way_is_turned_round():
    rig = Rig(negate_angle=True)
    rig.machine.open()
    assert rig.machine.read()[1:3] == (-0.25, -0.5)
    rig.machine.enable()
    rig.machine.command(Target(1.0, 2.0))
    rig.machine.stop()
    assert rig.commands() == [(0.25, 1.0), (-1.0, 2.0), (0.25, 1.0)]


def test_a_velocity_that_is_not_told_is_the_difference(rig):
    message = rig.transport.messages.joint(START + 10**9, "", "fin", 0.75, 0.0)
    message.velocity = np.zeros(0)
    rig.clock.sleep(0.99)
    rig.transport.put("/joint", message)
    assert rig.machine.read().velocity == pytest.approx(0.5 / 0.99, rel=1e-2)


def test_opening_and_closing_send_nothing(rig):
    rig.machine.stop()
    rig.machine.close()
    rig.machine.close()
    assert not rig.transport.sent
    assert rig.transport.closed


def test_nothing_moves_before_it_is_enabled_nor_after_a_stop(rig):
    with pytest.raises(DeviceError, match="not enabled"):
        rig.machine.command(Target(1.0, 2.0))
    rig.machine.enable()
    assert rig.commands() == [(0.25, 1.0)], "it holds where it is"
    rig.machine.command(Target(1.0, 2.0))
    rig.say(0.6)
    rig.machine.read()
    rig.machine.stop()
    rig.machine.stop()
    assert rig.commands() == [(0.25, 1.0), (1.0, 2.0), (0.6, 1.0)]
    with pytest.raises(DeviceError, match="not enabled"):
        rig.machine.command(Target(1.0, 2.0))
    rig.machine.close()
    assert len(rig.commands()) == 3


def test_a_machine_that_is_closed_while_it_moves_is_stopped(rig):
    rig.machine.enable()
    rig.machine.command(Target(1.0, 2.0))
    rig.machine.close()
    assert rig.commands()[-1] == (0.25, 1.0)


@pytest.mark.parametrize("target", [(2.0, 2.0), (0.0, 0.5), (np.nan, 2.0), (0.0, np.inf)])
def test_a_command_beyond_the_limits_is_refused(rig, target):
    rig.machine.enable()
    with pytest.raises(CommandError, match="this fin accepts"):
        rig.machine.command(Target(*target))
    assert len(rig.commands()) == 1


def test_a_fin_beyond_its_limits_is_not_enabled():
    rig = Rig()
    rig.transport.waiting.clear()
    rig.say(1.8)
    rig.machine.open()
    with pytest.raises(DeviceError, match=r"at 1.800 rad, outside -1.500 to 1.500 rad"):
        rig.machine.enable()
    assert not rig.transport.sent


def test_nobody_who_obeys_is_told_before_anything_moves(rig):
    rig.transport.readers["/command"] = 0
    with pytest.raises(DeviceError, match="no subscriber on /command"):
        rig.machine.enable()


def test_a_stop_holds_and_goes_to_the_stop_topic_whoever_reads_that():
    rig = Rig(stop_topic="/stop", stop_release=True)
    rig.machine.open()
    for readers in (1, 0):
        rig.transport.readers["/stop"] = readers
        rig.machine.enable()
        rig.machine.stop()
        assert rig.stops()[-2:] == [False, True]
        assert rig.commands()[-1] == (0.25, 1.0), (
            "its reader may be a recorder, and the driver hears commands alone"
        )


def test_a_machine_that_has_not_moved_its_fin_asks_for_a_stop_and_holds_nothing():
    rig = Rig(stop_topic="/stop")
    rig.machine.open()
    rig.machine.stop()
    assert rig.stops() == [True]
    assert rig.commands() == []


def test_a_stop_never_raises(rig):
    rig.machine.enable()
    rig.transport.failing = True
    rig.machine.stop()
    rig.machine.close()
    with pytest.raises(DeviceError, match="open it first"):
        rig.machine.read()
    rig.machine.stop()


def test_a_stop_in_the_middle_of_a_command_has_the_last_word(rig):
    rig.machine.enable()
    publisher = rig.machine._topics.commands.publisher
    send = publisher.send
    rig.sends = 0

    def interrupted(data):
        rig.sends += 1
        if rig.sends == 1:
            rig.machine.stop()
        send(data)

    publisher.send = interrupted
    rig.machine.command(Target(1.0, 2.0))
    assert rig.commands()[-1] == (0.25, 1.0)


def test_a_stop_holds_the_fin_where_it_is_by_now(rig):
    rig.machine.enable()
    rig.machine.command(Target(1.0, 2.0))
    rig.clock.sleep(0.3)
    # The loop has hung, while the fin went on.
    rig.say(0.8)
    rig.machine.stop()
    assert rig.commands()[-1] == (0.8, 1.0)


def test_a_stop_from_another_thread_ends_the_commands(rig):
    rig.machine.enable()
    thread = rig.clock.spawn(rig.machine.stop, "other")
    thread.join(1.0)
    assert not thread.is_alive()
    with pytest.raises(DeviceError, match="not enabled"):
        rig.machine.command(Target(1.0, 2.0))


def test_a_command_that_hangs_does_not_keep_a_stop_from_another_thread():
    rig = Rig(stop_topic="/stop")
    rig.machine.open()
    rig.machine.enable()
    publisher = rig.machine._topics.commands.publisher
    goes_on = rig.clock.event()
    send = publisher.send

    def hang(data):
        goes_on.wait()
        send(data)

    publisher.send = hang
    thread = rig.clock.spawn(lambda: rig.machine.command(Target(1.0, 2.0)), "loop")
    rig.clock.sleep(0.01)
    before = rig.clock()
    rig.machine.stop()
    assert rig.clock() - before < 0.6
    assert rig.stops() == [True]
    assert rig.transport.sent_at["/stop"][0] - before < 0.03
    goes_on.set()
    thread.join(1.0)
    assert not thread.is_alive()
    assert rig.commands()[-1] == (0.25, 1.0), "and the stop has the last word"


def test_a_reading_that_is_no_number_is_a_complaint(rig):
    rig.say(np.nan)
    sample = rig.machine.read()
    assert sample.angle == 0.25
    assert sample.complaints == (
        "/joint: message rejected: its position is nan, not finite; correct its publisher",
    )
    rig.say(0.3)
    assert rig.machine.read().complaints == ()


@pytest.mark.parametrize("topic", ["/joint", "/wrench"])
def test_a_second_publisher_of_readings_is_refused_and_reported_immediately(topic):
    rig = Rig()
    rig.transport.publishing[topic] = ["driver", "another"]
    words = f"{topic}: has 2 publishers (another, driver); stop all but one"
    with pytest.raises(DeviceError, match=re.escape(words)):
        rig.machine.open()
    assert rig.transport.closed
    rig.transport.publishing[topic] = ["driver"]
    rig.machine.open()
    assert rig.machine.read().complaints == ()
    rig.transport.publishing[topic] = ["driver", "another"]
    assert rig.machine.read().complaints == (words,)
    rig.transport.publishing[topic] = []
    assert rig.machine.read().complaints == (
        f"{topic}: no longer has a publisher; restart its driver",
    )


def test_a_second_publisher_of_commands_is_refused_and_reported_immediately(rig):
    words = "/command: teleop may also command this fin; close that program first"
    rig.transport.commanders = ["teleop"]
    with pytest.raises(DeviceError, match=words):
        rig.machine.enable()
    assert rig.machine.read().complaints == (words,)
    assert not rig.transport.sent
    rig.machine.close()
    rig.transport.deadlines.clear()
    with pytest.raises(DeviceError, match=words):
        rig.machine.open()
    assert rig.transport.deadlines == {}, "the other program would notice a publisher"
    rig.transport.commanders = []
    rig.machine.open()
    rig.machine.enable()
    assert rig.machine.read().complaints == ()


def test_only_one_program_commands_a_fin_but_it_may_command_several_fins():
    topic = f"/command_{os.getpid()}"

    def made(**changes):
        rig = Rig(**({"command_topic": topic} | changes))
        rig.machine.clock = REAL
        return rig.machine

    first = made()
    first.open()
    with pytest.raises(
        RigError,
        match=rf"fin behind {topic}: in use by another program \(process "
        rf"{os.getpid()}\); close that program first",
    ):
        made().open()
    others = [made(command_topic=f"{topic}_2"), made(connection={"domain": 77})]
    for machine in others:
        machine.open()
    first.close()
    second = made()
    second.open()
    for machine in (second, *others):
        machine.close()


def test_a_command_topic_that_cannot_be_locked_is_a_note(monkeypatch, rig):
    monkeypatch.setattr(rig.machine.device_lock, "note", "cannot be locked")
    assert rig.machine.notes == ("in memory", "cannot be locked")


def test_a_silent_topic_is_told_with_those_that_are_there():
    rig = Rig()
    del rig.transport.waiting["/wrench"]
    with pytest.raises(
        DeviceError,
        match=r"/wrench: no geometry_msgs/msg/WrenchStamped within 0.05 s; found "
        r"/somebody \(std_msgs/msg/Bool\); start its driver, or",
    ):
        rig.machine.open()
    assert rig.transport.closed


def test_another_joint_is_told_at_once_by_its_name():
    rig = Rig(joint_name="tail")
    with pytest.raises(DeviceError, match="no joint 'tail'; its joints are 'fin'"):
        rig.machine.open()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame": "z,x"}, "frame = 'z,x'"),
        ({"joint_topic": "joint"}, "joint_topic = 'joint'"),
        (
            {"limits": CONFIG["limits"] | {"angle_min_rad": 2.0}},
            "limits: angle_min_rad is 2, angle_max_rad is 1.5",
        ),
        (
            {"limits": CONFIG["limits"] | {"velocity_max_rad_s": 9000.0}},
            "velocity_max_rad_s is 9000; ",
        ),
        ({"joint": "/joint"}, "unknown key 'joint'; did you mean 'joint_name'"),
    ],
)
def test_a_configuration_that_cannot_be_is_told_in_one_line(change, words):
    with pytest.raises(ConfigurationError, match=words):
        Ros2PlantConfig.build(CONFIG | change)


@pytest.mark.parametrize(
    "name", ["joint_topic", "joint_name", "wrench_topic", "frame", "command_topic", "limits"]
)
def test_what_must_not_be_guessed_has_no_default(name):
    with pytest.raises(ConfigurationError, match=f"{name}.*required"):
        Ros2PlantConfig.build({key: value for key, value in CONFIG.items() if key != name})


def test_a_flipper_follows_the_command_at_its_velocity_twenty_times_a_second():
    rig = Rig(flipper=FLIPPER)
    rig.machine.open()
    rig.machine.enable()
    rig.machine.command(Target(1.25, 2.0))
    for _ in range(100):
        rig.clock.sleep(0.01)
        rig.machine.read()
    sent = rig.transport.sent["/command"][1:]
    assert len(sent) == 21
    angles = [message.zero_direction for message in sent]
    np.testing.assert_allclose(angles, np.minimum(0.25 + 0.1 * np.arange(21), 1.25), atol=1e-6)
    assert {message.amplitude for message in sent} == {0.0}
    rig.machine.stop()
    assert rig.transport.sent["/command"][-1].zero_direction == pytest.approx(0.25)
    count = len(rig.transport.sent["/command"])
    rig.clock.sleep(1.0)
    rig.machine.read()
    assert len(rig.transport.sent["/command"]) == count, "after a stop nothing is sent"


def test_a_flipper_that_was_stopped_by_its_topic_starts_again_from_where_it_is():
    rig = Rig(flipper=FLIPPER, stop_topic="/stop")
    rig.machine.open()
    rig.machine.enable()
    rig.machine.command(Target(1.25, 2.0))
    rig.machine.stop()
    rig.clock.sleep(1.0)
    rig.say(0.5)
    rig.machine.enable()
    assert rig.transport.sent["/command"][-1].zero_direction == pytest.approx(0.5)


def test_a_flipper_that_has_no_such_message_is_told_on_opening():
    with pytest.raises(
        RigError,
        match=r"flipper: own/msg/Flipper cannot be built .*; put the .msg text of each type",
    ):
        Rig(flipper={"type": "own/msg/Flipper"}).machine.open()
