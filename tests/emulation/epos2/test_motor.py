"""Profile position mode on a fin, without bus or time."""

import pytest

from softfin.emulation.epos2.motor import EmulatedMotor
from softfin.emulation.epos2.objects import values
from softfin.emulation.fin import FinMotion
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Units
from tests.rig.devices.epos2.bench import drive_config
from tests.rig.machines import Hours
from tests.rig.simple_fin import SimpleFin

ENABLED = 0x0F
START = 0x3F
RELATIVE = 0x7F


class TremblingFin(SimpleFin):
    """As a real one it is never quite at rest."""

    def now(self) -> FinMotion:
        motion = super().now()
        return motion._replace(angle=motion.angle + 3e-6, velocity=motion.velocity or 1e-4)


class Made:
    def __init__(self, fin: type[SimpleFin] = SimpleFin) -> None:
        self.clock = Hours()
        self.faults = []
        self.fin = fin(self.clock)
        self.values = values(drive_config())
        self.motor = EmulatedMotor(
            self.fin, Units.of(drive_config()), self.values.__getitem__, self.faults.append
        )
        self.word = ENABLED

    def control(self, *words: int, target: int | None = None) -> None:
        if target is not None:
            self.values[protocol.TARGET] = target
        for word in words:
            self.motor.control(word, self.word)
            self.word = word

    def pass_time(self, seconds: float) -> None:
        self.clock.now += seconds


@pytest.mark.parametrize("fin", [SimpleFin, TremblingFin])
def test_the_target_is_reached_when_the_profile_has_ended_and_not_before(
    fin: type[SimpleFin],
) -> None:
    made = Made(fin)
    assert made.motor.is_target_reached
    for target in (2000, -3000, 2001):
        made.control(ENABLED, START, target=target)
        assert not made.motor.is_target_reached
        made.pass_time(0.01)
        assert not made.motor.is_target_reached
        made.pass_time(3.0)
        assert made.motor.is_target_reached
        assert made.motor.position == pytest.approx(target, abs=1)


def test_a_target_beyond_the_limits_is_a_fault_and_a_relative_one_is_not_taken() -> None:
    made = Made()
    made.values[protocol.POSITION_MAX] = 2000
    made.control(ENABLED, RELATIVE, target=1000)
    assert not made.motor.acknowledged
    made.control(ENABLED, START, target=2000)
    assert made.motor.acknowledged
    assert made.faults == []
    made.control(ENABLED, START, target=2001)
    assert made.faults == [0xFF09]


def test_a_fin_arrives_at_its_target_itself_whatever_the_rounding() -> None:
    clock = Hours()
    fin = SimpleFin(clock)
    for angle in (0.1, 0.3, -0.7, 1.1, 1e-17):
        fin.move(angle, 3.0)
        clock.now += 2.0
        assert fin.now() == (angle, 0.0, angle, 0.0, (0.0,) * 6)
