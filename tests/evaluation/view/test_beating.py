import numpy as np
import pytest

from softfin.core.action_clock import ACTION_TICKS
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.evaluation.view.beating import BeatConfig, beat


def test_strokes_go_to_either_side_of_the_centre_on_the_action_clock():
    command = beat(BeatConfig(centre_rad=0.3), PAPER_LIMITS, 200)
    assert command.angle.shape == command.velocity.shape == (200,)
    turns = np.flatnonzero(np.diff(command.angle)) + 1
    np.testing.assert_array_equal(turns, np.cumsum(ACTION_TICKS * 2)[:-1])
    np.testing.assert_allclose(command.angle[[0, 40]], [0.8, -0.2], rtol=1e-6)


def test_a_gait_of_six_actions_is_as_long_as_the_window_of_the_mean():
    command = beat(BeatConfig(), PAPER_LIMITS, 400)
    np.testing.assert_array_equal(command.angle[:200], command.angle[200:])


@pytest.mark.parametrize(("fastest", "expected"), [(20.0, 4.5), (3.0, 3.0)])
def test_the_velocity_fills_two_thirds_of_an_action_where_the_plant_is_fast_enough(fastest, expected):
    command = beat(BeatConfig(), Limits(-1.5, 1.5, 0.5, fastest), 10)
    np.testing.assert_allclose(command.velocity, expected)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"centre_rad": 1.3}, "reaches 0.8 .. 1.8 rad; the plant takes -1.57 .. 1.57; ask for a centre nearer"),
        ({"velocity_rad_s": 30.0}, "beat.velocity_rad_s = 30: the plant takes 1 .. 3.14 rad/s"),
    ],
)
def test_commands_outside_the_limits_are_refused_in_one_line(values, words):
    with pytest.raises(ConfigurationError, match=r"^[^\n]+$") as error:
        beat(BeatConfig(**values), PAPER_LIMITS, 10)
    assert words in str(error.value)
