import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import RunError, SafetyStop
from softfin.rig.loop import run_controller
from tests.rig.machines import Wagging
from tests.rig.test_session import Made


def held(controller, actions=6, references=lambda at: (1.0, -1.0), zero=(0.0, 0.0)):
    made = Made()
    with made.session as session:
        session.activate()
        return made, list(run_controller(session, controller, references, actions, zero))


def test_three_actions_take_a_second_to_the_tick():
    _, acted = held(Wagging())
    assert [len(one.samples) for one in acted] == [*PAPER_CLOCK.ticks, *PAPER_CLOCK.ticks]
    assert sum(PAPER_CLOCK.ticks) == 100


def test_the_controller_sees_the_mean_force_since_its_last_action():
    controller = Wagging()
    _, acted = held(controller)
    assert controller.forces[0] == (0.0, 0.0)
    read = [np.mean([sample.wrench[0] for sample in one.samples]) for one in acted]
    x = [force[0] for force in controller.forces[1:]]
    # Each action is corrected for the delay of the sensor, but not their mean over a window.
    assert x == pytest.approx(read[:-1], abs=0.1)
    assert [force[1] for force in controller.forces[1:]] == pytest.approx([0.1] * len(x))


def test_the_controller_sees_forces_without_what_the_sensor_read_at_rest():
    raw = Wagging()
    zeroed = Wagging()
    held(raw)
    held(zeroed, zero=(0.3, -0.2))
    for force, plain in zip(zeroed.forces[1:], raw.forces[1:], strict=True):
        assert force == pytest.approx((plain[0] - 0.3, plain[1] + 0.2))


def test_the_controller_sees_mean_torque_and_power_since_its_last_action():
    made = Made()
    made.machine.torque_constant_nm_a = 2.5

    def loaded(sample):
        wrench = (*sample.wrench[:5], 0.4 + 0.1 * sample.angle)
        return sample._replace(current=0.1 + 0.5 * sample.angle, wrench=wrench)

    made.machine.altered = loaded
    controller = Wagging()
    with made.session as session:
        session.activate()
        zero = session.rest(0.5)
        acted = list(run_controller(session, controller, lambda at: (1.0, -1.0), 6, zero))
    assert controller.drives[0] == (None, None)
    for (shaft, motor), before in zip(controller.drives[1:], acted, strict=False):
        angle = np.array([sample.angle for sample in before.samples])
        velocity = np.array([sample.velocity for sample in before.samples])
        # The torque of the sensor is without its value at rest, at its own times.
        times = [(sample.time, sample.force_time) for sample in before.samples]
        sensed = np.interp(*np.transpose(times), 0.1 * angle)
        assert shaft == pytest.approx((sensed.mean(), np.mean(sensed * velocity)))
        torque = 2.5 * (0.1 + 0.5 * angle)
        # A current is the mean since the previous sample.
        between = (np.concatenate([velocity[:1], velocity[:-1]]) + velocity) / 2
        assert motor == pytest.approx((torque.mean(), np.mean(torque * between)), rel=1e-3)


def test_references_are_asked_for_at_the_time_of_each_action():
    controller = Wagging()
    held(controller, references=lambda at: (at, 0.0))
    assert [x for x, _ in controller.asked] == pytest.approx([0, 0.33, 0.66, 1.0, 1.33, 1.66])


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RunError("a controller acts on finite numbers alone"), "finite numbers"),
        (ZeroDivisionError("by zero"), "Zero"),
    ],
)
def test_a_controller_that_raises_stops_the_fin(error, words):
    def worse(action):
        if action == 2:
            raise error

    made = Made()
    with made.session as session:
        session.activate()
        with pytest.raises(SafetyStop, match=words) as raised:
            list(run_controller(session, Wagging(worse), lambda at: (0.0, 0.0), 9))
        assert raised.value.exit_code == 3
        assert not made.machine.enabled
        assert made.notes.events[-1].startswith("stopped: controller: ")


def test_references_that_fail_stop_the_fin():
    def references(at):
        raise OSError("topic is gone")

    made = Made()
    with made.session as session:
        session.activate()
        with pytest.raises(SafetyStop, match="topic is gone"):
            list(run_controller(session, Wagging(), references, 3))
        assert not made.machine.enabled
