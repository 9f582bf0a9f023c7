"""A session stops the fin on every fault of the servo, soon and with its reason."""

import math

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import COAST_RAD_S2
from softfin.emulation.rig import EmulatedRig
from softfin.rig.config import RigConfig
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.protocol import HardwareError
from softfin.rig.machine import Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from tests.rig.braking_fin import BrakingFin
from tests.rig.rigs import SAFETY

BRAKED_S = 0.1 + 0.05 + 2 * math.pi / 80.0
"""Longest time to rest [s]: the servo's own stop or the limit on the age of a reading, whichever
acts first, and the braking from the highest velocity, with a few ticks."""

COASTED_S = math.pi / COAST_RAD_S2 + 0.02
"""Likewise of a servo that has switched its torque off [s]."""


@pytest.fixture
def bench():
    clock = SimulatedClock()
    fin = BrakingFin(80.0, clock)
    with EmulatedRig(fin=fin, clock=clock, drive="dynamixel", sensor="lines") as behind:
        values = behind.values(safety=SAFETY, settle_s=0.1)
        values["drive"]["zero_needed"] = False
        yield behind, Rig(RigConfig.build(values), clock)


def flip(answer):
    return (bytes([*answer[:-1], answer[-1] ^ 0xFF]),)


def twice(answer):
    """A second servo answers at the same time, with another clock."""
    other = bytes([*answer[:16], answer[16] ^ 0x55, *answer[17:]]) if len(answer) > 20 else answer
    return (bytes(a & b for a, b in zip(answer, other, strict=True)),)


def set_transmit(transmit):
    return lambda servo: setattr(servo, "transmit", transmit)


FAULTS = {
    "silence": (lambda servo: servo.silence(), "angle", BRAKED_S),
    "lag": (lambda servo: setattr(servo, "delay_s", 0.02), "angle", BRAKED_S),
    "garbled answers": (set_transmit(flip), "angle", BRAKED_S),
    "nonsense": (set_transmit(lambda answer: (bytes(range(40)),)), "angle", BRAKED_S),
    "two at one ID": (set_transmit(twice), "angle", BRAKED_S),
    "overload": (lambda servo: servo.trip(HardwareError.OVERLOAD), "overload", COASTED_S),
    "voltage": (lambda servo: servo.trip(HardwareError.INPUT_VOLTAGE), "input vol", BRAKED_S),
    "restart": (lambda servo: servo.power_up(), "servo restarted", COASTED_S),
    "unplugged": (lambda servo: servo.unplug(), "angle", BRAKED_S),
}
"""For each fault, the words with which the session ends, and the longest time to rest [s]."""


class Watcher:
    """Notes when the fin comes to rest."""

    def __init__(self, behind):
        self.began = behind.clock()
        self.rest_s = math.inf
        behind.clock.spawn(lambda: self._watch(behind), "watcher")

    def _watch(self, behind):
        while behind.fin.now().velocity:
            behind.clock.sleep(0.001)
        self.rest_s = behind.clock() - self.began


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_motion_stops_the_fin(bench, fault):
    behind, rig = bench
    provoke, words, longest_s = FAULTS[fault]
    with Session(rig, Guard(rig.config.safety, rig.limits)) as made:
        made.activate()
        made.hold(Target(-1.5, math.pi), 40)
        made.hold(Target(1.5, math.pi), 20)
        assert behind.fin.now().velocity
        watcher = Watcher(behind)
        provoke(behind.drive)
        with pytest.raises(SafetyStop, match=words):
            made.hold(Target(1.5, math.pi), 33)
    behind.clock.sleep(0.5)
    assert watcher.rest_s <= longest_s
    # The operator is told if the torque may still be on.
    assert rig.stop_unconfirmed or behind.drive.get(protocol.TORQUE_ENABLE) == 0


def test_a_target_that_the_servo_refuses_stops_the_fin(bench):
    behind, rig = bench
    with Session(rig, Guard(rig.config.safety, rig.limits)) as made:
        made.activate()
        behind.drive.set(protocol.MAX_POSITION_LIMIT, 2200)
        with pytest.raises(SafetyStop, match=r"refused a target \(error 6, data limit\)"):
            made.hold(Target(1.0, 1.0), 5)
    assert behind.drive.get(protocol.TORQUE_ENABLE) == 0


def test_a_session_that_ends_leaves_the_torque_off(bench):
    behind, rig = bench
    with Session(rig, Guard(rig.config.safety, rig.limits)) as made:
        made.activate()
        made.hold(Target(1.0, 2.0), 20)
        assert behind.drive.get(protocol.TORQUE_ENABLE) == 1
    assert behind.drive.get(protocol.TORQUE_ENABLE) == 0
    assert rig.stop_unconfirmed is None
