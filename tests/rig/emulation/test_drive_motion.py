"""Profile position mode on a fin, without bus or time."""

import pytest

from softfin.rig.emulation.drive_dictionary import values
from softfin.rig.emulation.drive_motion import Motion
from softfin.rig.emulation.fin import Motion as Moving
from softfin.rig.emulation.simple import SimpleFin
from softfin.rig.epos2 import objects
from softfin.rig.epos2.config import Units
from tests.rig.epos2_bench import drive_config
from tests.rig.machines import Hours

ENABLED, START, HALT = 0x0F, 0x3F, 0x10F


class TremblingFin(SimpleFin):
    """As a real one it is never quite at rest."""

    def now(self) -> Moving:
        motion = super().now()
        return motion._replace(angle=motion.angle + 3e-6, velocity=motion.velocity or 1e-4)


class Made:
    def __init__(self, fin: type[SimpleFin] = SimpleFin) -> None:
        self.clock, self.faults = Hours(), []
        self.fin = fin(self.clock)
        self.values = values(drive_config())
        self.motion = Motion(self.fin, Units.of(drive_config()), self.values.__getitem__, self.faults.append)
        self.word = ENABLED

    def control(self, *words: int, target: int | None = None) -> None:
        if target is not None:
            self.values[objects.TARGET] = target
        for word in words:
            self.motion.control(word, self.word)
            self.word = word

    def pass_time(self, seconds: float) -> None:
        self.clock.now += seconds
        self.motion.tick()


@pytest.mark.parametrize("fin", [SimpleFin, TremblingFin])
def test_the_target_is_reached_when_the_profile_has_ended_and_not_before(fin: type[SimpleFin]) -> None:
    made = Made(fin)
    assert made.motion.is_target_reached
    for target in (2000, -3000, 2001):
        made.control(ENABLED, START, target=target)
        assert not made.motion.is_target_reached
        made.pass_time(0.01)
        assert not made.motion.is_target_reached
        made.pass_time(3.0)
        assert made.motion.is_target_reached
        assert made.motion.position == pytest.approx(target, abs=1)


@pytest.mark.parametrize("fin", [SimpleFin, TremblingFin])
def test_a_halted_motor_has_reached_its_target_when_it_stands_and_goes_on_after_it(fin: type[SimpleFin]) -> None:
    made = Made(fin)
    made.control(START, target=2000)
    made.pass_time(0.01)
    made.control(HALT)
    halted = made.motion.position
    assert made.motion.is_target_reached
    made.pass_time(3.0)
    assert made.motion.position == halted < 2000
    made.control(ENABLED)
    assert not made.motion.is_target_reached
    made.pass_time(3.0)
    assert made.motion.position == pytest.approx(2000, abs=1)


def test_set_points_that_are_not_for_at_once_follow_each_other() -> None:
    made = Made()
    made.control(0x1F, ENABLED, target=2000)
    made.control(0x1F, ENABLED, target=-2000)
    assert made.motion.is_acknowledged
    made.pass_time(3.0)
    assert not made.motion.is_acknowledged
    assert made.motion.position == 2000
    made.pass_time(3.0)
    assert made.motion.position == -2000


def test_a_set_point_beyond_the_limits_is_a_fault_when_its_turn_comes() -> None:
    made = Made()
    made.values[objects.POSITION_MAX] = 2000
    made.control(0x1F, ENABLED, target=2000)
    made.control(0x1F, ENABLED, target=2001)
    assert made.faults == []
    made.pass_time(3.0)
    assert made.faults == [0xFF09]


def test_a_fin_arrives_at_its_target_itself_whatever_the_rounding() -> None:
    clock = Hours()
    fin = SimpleFin(clock)
    for angle in (0.1, 0.3, -0.7, 1.1, 1e-17):
        fin.move(angle, 3.0)
        clock.now += 2.0
        assert fin.now() == (angle, 0.0, angle, 0.0, (0.0,) * 6)
