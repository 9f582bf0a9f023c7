import math

import pytest

from softfin.core.quantities import RATE_HZ
from softfin.rig.machine import Sample
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from softfin.rig.shaft_torque import JUDGED_S, ShaftTorque
from tests.rig.machines import FreeFin

ACTION_TICKS = 33
DRAG_NM_S = 0.2
POWER_W = DRAG_NM_S / 2
"""Mean power of the drag: the mean square of the velocity is 1/2."""
CONSTANT_NM_A = 2.5


def action(torque=None, current=None, swing_rad=1.0, index=0, delay_ticks=0):
    """The samples of one stroke back and forth; torque and current are functions of the velocity,
    and not measured by default."""
    samples = []
    for tick in range(index * ACTION_TICKS, (index + 1) * ACTION_TICKS):
        phase = 2 * math.pi * tick / ACTION_TICKS
        velocity = swing_rad * math.cos(phase)
        delayed = swing_rad * math.cos(phase - 2 * math.pi * delay_ticks / ACTION_TICKS)
        wrench = (1.0, 0.5, 0.0, 0.0, 0.0, 0.0 if torque is None else torque(delayed))
        amperes = None if current is None else current(velocity)
        angle = swing_rad * math.sin(phase)
        force_time = (tick - delay_ticks) / RATE_HZ
        samples.append(
            Sample(tick / RATE_HZ, angle, velocity, amperes, None, force_time, wrench, ())
        )
    return samples


def drag(velocity):
    return 0.4 + DRAG_NM_S * velocity


def made(constant_nm_a=None, rest_nm=0.0, uses=None):
    machine = FreeFin()
    machine.torque_constant_nm_a = constant_nm_a
    session = Session(machine, Guard(SafetyConfig(), machine.limits))
    session.at_rest = action(torque=lambda velocity: rest_nm)
    warnings = []
    return ShaftTorque(session, warnings.append, uses), warnings


def test_the_torque_of_the_sensor_is_relative_to_its_value_at_rest():
    torques, warnings = made(rest_nm=0.3)
    assert torques.means(action(torque=drag)) == (pytest.approx((0.1, POWER_W)), None)
    assert not warnings


def test_the_torque_of_the_motor_is_that_of_its_current():
    torques, warnings = made(CONSTANT_NM_A)
    shaft, motor = torques.means(action(current=drag))
    assert shaft is None
    # The power is that at the velocity of half a tick before.
    assert motor == pytest.approx((CONSTANT_NM_A * 0.4, CONSTANT_NM_A * POWER_W), rel=0.01)
    assert not warnings


def test_both_are_measured_independently():
    torques, _ = made(CONSTANT_NM_A)
    shaft, motor = torques.means(action(torque=drag, current=lambda velocity: 2 * drag(velocity)))
    assert (shaft[0], motor[0]) == pytest.approx((0.4, CONSTANT_NM_A * 0.8))


def test_the_torque_is_that_of_the_action_although_the_sensor_is_late():
    """All but the end of the action, which is not yet known."""
    torques, _ = made()
    shaft, _ = torques.means(action(torque=drag, delay_ticks=3))
    early, _ = torques.means(action(torque=drag))
    assert shaft == pytest.approx(early, rel=0.05)


def test_neither_sensor_nor_current_is_no_torque():
    torques, warnings = made(CONSTANT_NM_A, uses="both")
    for _ in range(30):
        assert torques.means(action()) == (None, None)
    assert not warnings


@pytest.mark.parametrize("first", [None, drag])
def test_feedback_that_needs_a_torque_says_once_that_there_is_none(first):
    torques, warnings = made(CONSTANT_NM_A, uses="torque")
    torques.means(action(torque=first))
    for _ in range(30):
        torques.means(action())
    assert len(warnings) == (first is None)
    assert all("no torque is measured" in line and "\n" not in line for line in warnings)


def test_the_delay_of_an_experiment_does_not_affect_the_next():
    torques, _ = made()
    samples = [
        each._replace(wrench=(each.velocity, *each.wrench[1:])) for each in action(delay_ticks=3)
    ]
    first = torques.force(samples, 6)
    assert torques.force(action(), 6) != (1.0, 0.5)
    torques.start()
    assert torques.force(samples, 6) == first


@pytest.mark.parametrize(("uses", "lines"), [("both", 1), ("torque", 1), (None, 0)])
def test_a_current_without_a_torque_constant_is_not_used_and_noted_once(uses, lines):
    torques, warnings = made(uses=uses)
    for _ in range(30):
        assert torques.means(action(current=drag)) == (None, None)
    assert len(warnings) == lines
    assert all("drive.torque_constant_nm_a" in line for line in warnings)


@pytest.mark.parametrize("value", [0.0, 0.7, math.nan, math.inf])
def test_a_channel_that_is_frozen_or_not_finite_is_no_torque_in_that_action_only(value):
    torques, _ = made(CONSTANT_NM_A, rest_nm=0.3)

    def stuck(velocity):
        return value

    shaft, motor = torques.means(action(torque=stuck, current=drag))
    assert shaft is None
    assert motor is not None
    shaft, motor = torques.means(action(torque=drag, current=stuck))
    assert shaft is not None
    assert motor is None
    assert None not in torques.means(action(torque=drag, current=drag))


def clipped(velocity):
    return min(drag(velocity), 0.5)


@pytest.mark.parametrize(("uses", "lines"), [("both", 1), (None, 0)])
def test_a_torque_that_sits_at_a_limit_is_missing_meanwhile_and_noted_once(uses, lines):
    torques, warnings = made(CONSTANT_NM_A, uses=uses)
    for _ in range(3):
        shaft, motor = torques.means(action(torque=clipped, current=clipped))
        assert (shaft is None) == bool(lines)
        assert motor is not None
        assert None not in torques.means(action(torque=drag, current=drag))
    assert len(warnings) == lines
    assert all("torque_z: saturated at 0.5," in line and "\n" not in line for line in warnings)


@pytest.mark.parametrize(("uses", "lines"), [("force", 1), (None, 0)])
def test_a_force_that_sits_at_a_limit_is_missing_meanwhile(uses, lines):
    torques, warnings = made(uses=uses)

    def pushed(limit):
        return [
            each._replace(wrench=(min(each.velocity, limit), *each.wrench[1:])) for each in action()
        ]

    x, y = torques.force(pushed(0.5), 6)
    assert math.isnan(x) == bool(lines)
    assert y == pytest.approx(0.5)
    assert math.isfinite(torques.force(pushed(2.0), 6)[0])
    assert len(warnings) == lines
    assert all(line.startswith("force_x: saturated at 0.5,") for line in warnings)


def test_a_slow_sensor_that_repeats_its_records_is_not_saturated():
    torques, warnings = made(uses="both")
    samples = action(torque=drag)
    slow = [samples[10 * (index // 10)] for index in range(len(samples))]
    held = [
        each._replace(wrench=record.wrench, force_time=record.force_time)
        for each, record in zip(samples, slow, strict=True)
    ]
    assert torques.means(held)[0] is not None
    assert not warnings


def test_a_current_that_is_missing_for_a_tick_is_no_torque():
    torques, _ = made(CONSTANT_NM_A)
    samples = action(current=drag)
    samples[5] = samples[5]._replace(current=None)
    assert torques.means(samples) == (None, None)


def test_a_constant_torque_at_rest_is_a_torque():
    torques, _ = made(rest_nm=0.3)
    held = action(torque=lambda velocity: 0.5, swing_rad=0.01)
    assert torques.means(held)[0][0] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("channel", "setting"), [("torque", "sensor.frame"), ("current", "the driver")]
)
def test_a_torque_of_the_wrong_sign_is_told_once_and_no_longer_used(channel, setting):
    torques, warnings = made(CONSTANT_NM_A)
    judged = math.ceil(JUDGED_S * RATE_HZ / ACTION_TICKS)
    signals = {"torque": drag, "current": drag}
    wrong = signals | {channel: lambda velocity: -drag(velocity)}
    index = list(signals).index(channel)
    means = [torques.means(action(**wrong)) for _ in range(200)]
    assert None not in [each[index] for each in means[: judged - 1]]
    assert {each[index] for each in means[judged - 1 :]} == {None}
    assert torques.means(action(**signals))[index] is None
    # The other one stays.
    assert None not in [each[1 - index] for each in means]
    (line,) = warnings
    assert setting in line
    assert "\n" not in line


def test_a_torque_of_the_right_sign_is_used_for_good():
    torques, warnings = made(CONSTANT_NM_A)
    assert all(None not in torques.means(action(drag, drag)) for _ in range(300))
    assert not warnings


def test_time_at_rest_does_not_count():
    """Noise alone has no sign."""
    torques, warnings = made(rest_nm=0.3)
    still = action(torque=lambda velocity: 0.3 - velocity, swing_rad=0.01)
    assert None not in [torques.means(still)[0] for _ in range(300)]
    assert not warnings
