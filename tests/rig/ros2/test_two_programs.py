"""Two programs that command the same ROS 2 fin, in simulated time: softfin stops the fin or refuses
the second program."""

import pytest

from softfin.core.errors import DeviceError, SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.rig.machine import Target
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.ros2.connection import Subscription
from softfin.rig.ros2.plant import Ros2Machine
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from softfin.storage.bag.messages import JOINT_STATE, WRENCH_STAMPED, cdr
from tests.rig.braking_fin import BrakingFin
from tests.rig.ros2.test_plant import CONFIG
from tests.rig.simulated_topics import SimulatedTransport

LOAD_N = 40.0
"""Above the limit."""


class Driver:
    """A fin and its driver; `force_n` is what its sensor measures."""

    def __init__(self, clock):
        self.clock = clock
        self.fin = BrakingFin(60.0, clock)
        self.force_n = 0.0
        self.transport = SimulatedTransport(clock)
        self.joint = self.transport.publish("/joint", JOINT_STATE)
        self.wrench = self.transport.publish("/wrench", WRENCH_STAMPED)
        self.commands = Subscription(
            self.transport,
            "/command",
            JOINT_STATE,
            lambda message: (message.position[0], message.velocity[0]),
            stamped=False,
        )
        self.ending = clock.event()
        self.thread = clock.spawn(self._run, "driver")

    def _run(self):
        while not self.ending.wait(0.01):
            for _, (angle, velocity) in self.commands.take():
                self.fin.move(float(angle), float(velocity))
            state = self.fin.now()
            stamp = round(self.clock.wall() * 1e9)
            self.joint.send(cdr(JOINT_STATE, stamp, (state.angle, state.velocity), "", "fin"))
            self.wrench.send(cdr(WRENCH_STAMPED, stamp, (self.force_n,) + (0.0,) * 5, ""))


@pytest.fixture
def driver():
    made = Driver(SimulatedClock())
    yield made
    made.ending.set()
    made.thread.join()


def machine_of(driver):
    config = Ros2PlantConfig.build(CONFIG | {"wait_s": 1.0})
    return Ros2Machine(config, driver.clock, lambda *_: SimulatedTransport(driver.clock))


def activated(driver):
    machine = machine_of(driver)
    return Session(machine, Guard(SafetyConfig(), machine.limits))


def test_a_second_host_is_refused_and_the_first_continues(driver):
    with activated(driver) as session:
        session.activate()
        session.hold(Target(1.0, 1.0), 20)
        with pytest.raises(DeviceError, match=r"/command: node \d+ may also command this fin"):
            machine_of(driver).open()
        session.hold(Target(0.5, 1.0), 100)
        assert driver.fin.now().angle == pytest.approx(0.5, abs=0.01)


def test_a_second_publisher_of_commands_stops_the_fin_and_is_reported(driver):
    with activated(driver) as session:
        session.activate()
        session.hold(Target(1.0, 1.0), 20)
        SimulatedTransport(driver.clock).publish("/command", JOINT_STATE)
        with pytest.raises(SafetyStop, match=r"/command: node \d+ may also command this fin"):
            session.hold(Target(1.0, 1.0), 1)
        driver.clock.sleep(0.1)
        assert driver.fin.now().velocity == 0.0


def test_a_second_driver_that_hides_an_overload_stops_the_fin(driver):
    with activated(driver) as session:
        session.activate()
        session.hold(Target(1.0, 1.0), 20)
        second = SimulatedTransport(driver.clock).publish("/wrench", WRENCH_STAMPED)
        driver.force_n = LOAD_N
        stamp = round(driver.clock.wall() * 1e9)
        second.send(cdr(WRENCH_STAMPED, stamp, (0.0,) * 6, ""))
        with pytest.raises(SafetyStop, match=r"/wrench: has 2 publishers \(node \d+, node \d+\)"):
            session.hold(Target(1.0, 1.0), 1)
