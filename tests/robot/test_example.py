"""The example that closes a loop around the wrench: its body, its fins, and the loop with fins that
make what they are asked for."""

import sys

import numpy as np
import pytest

from softfin.control.controller import Measured
from softfin.control.store import load_controller
from softfin.core.quantities import RATE_HZ
from softfin.stages.example import EXAMPLE
from softfin.tank import Tank, TankConfig
from tests.documents import ROOT
from tests.staged import COARSE

NONE = np.zeros(6)


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples/robot"))
    import hold_position

    yield hold_position
    for name in ("hold_position", "body", "fins"):
        sys.modules.pop(name, None)


@pytest.fixture
def box(example):
    return sys.modules["body"].BodyDescription(
        mass_kg=6,
        inertia_kg_m2=(0.05, 0.1, 0.12),
        added_mass=(4, 8, 12, 0.05, 0.1, 0.1),
        centre_of_gravity_m=(0.01, 0.02, -0.03),
    )


@pytest.fixture
def gaits():
    return load_controller(EXAMPLE / "gaits")


def test_nothing_but_drag_takes_energy_from_a_body(example, box):
    config = box._replace(centre_of_gravity_m=(0, 0, 0))
    body = example.Body(config, NONE, NONE)
    for twist in np.random.default_rng(0).normal(size=(20, 6)):
        state = example.REST._replace(twist=twist)
        power = twist @ body.inertia @ body.acceleration(state, NONE)
        assert power == pytest.approx(0, abs=1e-9)


def test_the_axes_of_a_body_stay_at_right_angles(example, box):
    body = example.Body(box, NONE, NONE)
    state = example.REST._replace(twist=np.array([0.3, -0.2, 0.1, 0.8, -0.5, 1.0]))
    for _ in range(1000):
        state = body.step(state, NONE, np.zeros(3))
    np.testing.assert_allclose(state.rotation @ state.rotation.T, np.eye(3), atol=1e-9)


def test_a_body_that_is_pushed_reaches_the_speed_at_which_drag_equals_the_push(example, box):
    config = box._replace(centre_of_gravity_m=(0, 0, 0))
    body = example.Body(config, np.full(6, 2.0), np.full(6, 8.0))
    state = example.REST
    current = np.array([0.0, 0.2, 0.0])
    for _ in range(6000):
        push = np.array([3.0, 0, 0, 0, 0, 0])
        state = body.step(state, body.acceleration(state, push), current)
    speed = state.twist[0]
    assert 2 * speed + 8 * speed**2 == pytest.approx(3, rel=1e-3)
    assert state.position[1] == pytest.approx(0.2 * 60), "carried along"


def test_a_body_turns_upright(example, box):
    config = box._replace(centre_of_gravity_m=(0, 0, -0.03), centre_of_buoyancy_m=(0, 0, 0.03))
    body = example.Body(config, np.full(6, 0.5), NONE)
    tilted = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    state = example.REST._replace(rotation=tilted)
    for _ in range(3000):
        state = body.step(state, body.acceleration(state, NONE), np.zeros(3))
    assert state.rotation[2, 2] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("angle", [0.0, 1.0, 3.0, -2.0])
def test_gaits_are_turned_into_the_direction_of_the_reference(example, gaits, angle):
    from fins import TurningGaits

    controller = TurningGaits(gaits)
    straight = TurningGaits(gaits)
    # Thrust points along (cos a, -sin a).
    force = 2 * np.array([np.cos(angle), -np.sin(angle)])
    for _ in range(12):
        command = controller.act(Measured(angle, np.zeros(2)), force)
        other = straight.act(Measured(0.0, np.zeros(2)), np.array([2.0, 0.0]))
        assert command.angle == pytest.approx(other.angle + angle, abs=1e-6)


def test_fins_on_a_body_at_rest_make_the_forces_of_their_gaits(example, gaits):
    from fins import TankFins

    robot = example.load_robot("ucat")
    tank = Tank(TankConfig.build(COARSE, "tank"))
    fins = TankFins(robot, gaits, tank, [0, 20, 40, 60])
    references = np.array([[2.0, 0.0], [1.5, 1.0], [-1.5, 1.0], [0.0, -2.0]])
    wrench = [fins.tick(references, NONE, NONE) for _ in range(6 * RATE_HZ)]
    mean = np.mean(wrench[-2 * RATE_HZ :], axis=0)
    target = robot.matrix() @ references.ravel()
    # Another tank than that of the gaits.
    np.testing.assert_allclose(mean, target, atol=0.15 * np.linalg.norm(references))


@pytest.mark.parametrize("direction", [0.0, 1.6, 3.0])
def test_the_robot_returns_after_a_push_against_the_current(example, direction):
    robot = example.load_robot("ucat")
    body = example.Body(example.UCAT, example.DRAG_LINEAR, example.DRAG_QUADRATIC)
    matrix = robot.matrix()
    around = np.array([np.cos(direction), np.sin(direction), 0])
    push = example.Push(0.03 * around, around, 30.0)
    run = example.hold_position(
        robot, body, lambda references, *_: matrix @ references.ravel(), 3.0, 70, push
    )
    assert 0.01 < run.distance_m[31 * RATE_HZ : 40 * RATE_HZ].max() < 0.1
    assert run.distance_m[-RATE_HZ:].max() < 0.01
    assert np.abs(run.heading_rad[-RATE_HZ:]).max() < 0.02
    assert run.tilt_rad.max() < 0.1
