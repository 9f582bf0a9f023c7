"""Robots' files: what is refused, and how."""

from pathlib import Path
from textwrap import dedent

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


def test_a_fin_s_axes_turn_from_thrust_towards_minus_y(ucat):
    axes = ucat.fins["front_right"].axes()
    assert axes[:, 1].tolist() == pytest.approx([0, 0, 1], abs=1e-6)
    assert isinstance(ucat, RobotConfig)


def test_the_example_of_the_document_is_a_robot():
    text = (Path(__file__).parents[2] / "docs" / "robot.md").read_text()
    example = dedent(text.partition("## The robot file\n\n")[2].partition("\n\n`softfin")[0])
    assert RobotConfig.build(yaml.safe_load(example)).matrix().shape == (6, 4)


@pytest.mark.parametrize("given", [4.0, {"front_right": 1.0, "back_right": 2.0, "back_left": 3.0}])
def test_a_fin_s_thrust_is_one_number_or_its_own(ucat, given):
    if isinstance(given, dict):
        given["front_left"] = 4.0
        assert max_thrust_per_fin(ucat, given) == [1.0, 2.0, 3.0, 4.0]
    else:
        assert max_thrust_per_fin(ucat, given) == [4.0] * 4
