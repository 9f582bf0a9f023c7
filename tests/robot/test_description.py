"""Robots' files: what is refused, and how."""

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import yaml

from softfin.core.errors import ConfigurationError
from softfin.robot.check import check_robot
from softfin.robot.description import RobotConfig, load_robot, max_thrust_per_fin


@pytest.fixture
def values(ucat):
    return ucat.model_dump(mode="json")


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("fins.front_left.shaft_axis", [0.5, 0.5, 0.0], "shaft_axis = .* has length 0.7071"),
        ("fins.front_left.zero_direction", [0.5, 0.8660254, 0.0], "right angles to its shaft"),
        ("body.inertia_kg_m2", [0.1, 0.0, 0.1], "singular"),
        ("fins", {}, "fins"),
    ],
)
def test_a_file_that_describes_no_robot_is_refused_in_one_line(
    values, path, value, words, tmp_path
):
    *parents, name = path.split(".")
    place = values
    for parent in parents:
        place = place[parent]
    place[name] = value
    file = tmp_path / "robot.yaml"
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigurationError, match=words) as caught:
        load_robot(str(file))
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_that_is_not_there_is_told_with_those_that_are():
    with pytest.raises(ConfigurationError, match=r"nemo\.yaml: .* ucat"):
        load_robot("nemo.yaml")


THRUST_N = [3.0, 3.0, 3.0, 3.0]


def test_a_check_tells_rank_and_reach(ucat):
    found = check_robot(ucat, THRUST_N)
    assert found["rank"] == 6
    assert set(found["rank_without"].values()) == {6}
    assert found["max_thrust_n"]["front_left"] == 3
    # Along the nose each fin has the cosine of 30 degrees of its force, upwards all of it.
    assert found["reach"]["surge"] == pytest.approx(4 * 0.866 * 3, rel=0.02)
    assert found["reach"]["heave"] == pytest.approx(4 * 3, rel=0.02)
    # Of the water that moves along, 40 kg in surge, the fins accelerate twice the body's own mass.
    mass = ucat.body.mass_kg + ucat.body.added_mass[0]
    assert found["acceleration"]["surge"] == pytest.approx(found["reach"]["surge"] / mass, rel=0.01)
    assert found["sinks_n"] == 0


@pytest.mark.parametrize("gravity_z", [-0.02, 0.1])
def test_a_check_says_how_the_body_swings(ucat, gravity_z):
    """A centre of gravity far from the origin couples roll and sway."""
    body = {"centre_of_gravity_m": [0, 0, gravity_z], "centre_of_buoyancy_m": [0, 0, 0.2]}
    robot = ucat.merged({"body": body}, "test")
    found = check_robot(robot, THRUST_N)
    righting = 18.5 * 9.81 * (0.2 - gravity_z)
    assert found["righting_nm_rad"] == pytest.approx(righting, abs=1e-3)
    assert found["problems"] == []
    # All six degrees of freedom at once: omega^2 are the eigenvalues of M^-1 K.
    stiffness = np.diag([0, 0, 0, righting, righting, 0])
    squares = np.linalg.eigvals(np.linalg.inv(robot.body.inertia()) @ stiffness)
    hertz = np.sqrt(np.sort(squares.real)[-2:]) / (2 * np.pi)
    np.testing.assert_allclose(sorted(found["swing_hz"].values()), hertz, atol=1e-3)


@pytest.mark.parametrize(
    ("buoyancy_z", "words"),
    [(-0.07, "9.07 N m/rad"), (-0.02, "do not right it")],
)
def test_a_check_names_a_body_that_does_not_stay_upright(ucat, buoyancy_z, words):
    robot = ucat.merged({"body": {"centre_of_buoyancy_m": [0, 0, buoyancy_z]}}, "test")
    found = check_robot(robot, THRUST_N)
    (problem,) = found["problems"]
    assert words in problem
    assert problem.startswith("body: unstable in roll and pitch")
    assert found["swing_hz"] == {}


def test_a_fin_s_axes_turn_from_thrust_towards_minus_y(ucat):
    axes = ucat.fins["front_right"].axes()
    assert axes[:, 1].tolist() == pytest.approx([0, 0, 1], abs=1e-6)
    assert isinstance(ucat, RobotConfig)


def test_the_example_of_the_document_is_a_robot():
    text = (Path(__file__).parents[2] / "docs" / "robot.md").read_text()
    example = dedent(text.partition("## The robot's file\n\n")[2].partition("\n\n`softfin")[0])
    assert RobotConfig.build(yaml.safe_load(example)).matrix().shape == (6, 4)


@pytest.mark.parametrize("given", [4.0, {"front_right": 1.0, "back_right": 2.0, "back_left": 3.0}])
def test_a_fin_s_thrust_is_one_number_or_its_own(ucat, given):
    if isinstance(given, dict):
        given["front_left"] = 4.0
        assert max_thrust_per_fin(ucat, given) == [1.0, 2.0, 3.0, 4.0]
    else:
        assert max_thrust_per_fin(ucat, given) == [4.0] * 4
