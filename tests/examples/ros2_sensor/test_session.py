"""A session with an EPOS2 stops the fin on every fault of a force sensor behind a ROS 2 topic."""

import math

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.device import SENSORS, Emulator
from softfin.emulation.rig import EmulatedRig
from softfin.rig.config import RigConfig
from softfin.rig.machine import Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from tests.examples.ros2_sensor.emulated_topic import EmulatedTopic
from tests.examples.ros2_sensor.installed import install, simulate_topics
from tests.rig.braking_fin import BrakingFin
from tests.rig.rigs import values_of
from tests.rig.simulated_topics import SimulatedTransport
from tests.rig.still_fin import StillFin


def start_emulator(config, fin, clock):
    return EmulatedTopic(SimulatedTransport(clock), fin, config.rate_hz, clock, config.topic)


EMULATOR = Emulator(
    {"topic": "/emulated/wrench", "rate_hz": 320.0, "filter_delay_s": 0.0}, start_emulator
)


@pytest.fixture
def bench(monkeypatch):
    clock = SimulatedClock()
    install(monkeypatch)
    simulate_topics(monkeypatch, clock)
    monkeypatch.setitem(SENSORS, "ros2", EMULATOR)
    with EmulatedRig(fin=BrakingFin(80.0, clock), clock=clock, sensor="ros2") as behind:
        config = RigConfig.build(values_of(behind))
        yield behind, Rig(config, clock)


def change(sensor, **fields):
    sensor.transmit = lambda message: (message._replace(**fields),)


def lag(sensor):
    """Each message arrives later than the one before."""
    first_ns = []

    def delay(message):
        first_ns.append(message.stamp_ns)
        return (message._replace(stamp_ns=(first_ns[0] + message.stamp_ns) // 2),)

    sensor.transmit = delay


FAULTS = {
    "silence": (lambda sensor: sensor.silence(), "no new force for"),
    "lag": (lag, "no new force for"),
    "nonsense": (lambda sensor: change(sensor, wrench=(math.nan,) * 6), "force x is nan"),
    "old stamps": (lambda sensor: change(sensor, stamp_ns=1), "time stamps do not increase"),
    "no stamps": (lambda sensor: change(sensor, stamp_ns=0), "header.stamp is 0"),
    "unplugged": (lambda sensor: sensor.unplug(), "no longer has a publisher"),
}
"""For each fault, the words with which the session ends."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_motion_stops_the_fin(bench, fault):
    behind, rig = bench
    provoke, words = FAULTS[fault]
    with Session(rig, Guard(rig.config.safety, rig.limits)) as made:
        made.activate()
        made.hold(Target(-1.5, math.pi), 40)
        made.hold(Target(1.5, math.pi), 20)
        assert behind.fin.now().velocity
        provoke(behind.sensor)
        with pytest.raises(SafetyStop, match=words):
            made.hold(Target(1.5, math.pi), 33)
    behind.clock.sleep(0.2)
    assert behind.fin.now().velocity == 0
    assert rig.stop_unconfirmed is None


def test_a_second_publisher_in_motion_stops_the_fin(bench):
    behind, rig = bench
    with Session(rig, Guard(rig.config.safety, rig.limits)) as made:
        made.activate()
        made.hold(Target(-1.5, math.pi), 40)
        transport = SimulatedTransport(behind.clock)
        second = EmulatedTopic(transport, StillFin(), 320.0, behind.clock, behind.sensor.topic)
        with pytest.raises(SafetyStop, match=r"has 2 publishers \(node \d+, node \d+\); stop all"):
            made.hold(Target(1.5, math.pi), 33)
        second.close()
    behind.clock.sleep(0.2)
    assert behind.fin.now().velocity == 0
