import math
import subprocess
import sys

import numpy as np
import pytest

from softfin.control.policy import rest_action
from softfin.core.plant import rest_command
from softfin.core.quantities import (
    PAPER_LIMITS,
    Command,
    Limits,
    Log,
    Reading,
    action_to_command,
    command_limits,
    tick_at,
)

ARE_READINGS = """
import numpy as np
from softfin.core.quantities import AnyArray
import jax, jax.numpy as jnp
from jaxtyping import Float
kind = Float[AnyArray, "2"]
arrays = (np.zeros(2, np.float32), jnp.zeros(2), jnp.zeros(3), [0.0, 0.0])
assert [isinstance(x, kind) for x in arrays] == [True, True, False, False]
assert jax.eval_shape(lambda x: x * isinstance(x, kind), jnp.zeros(2)).shape == (2,)
"""


def test_arrays_of_both_kinds_are_readings_whether_jax_is_imported_afterwards_or_before():
    subprocess.run([sys.executable, "-c", ARE_READINGS], check=True)
    assert "jax" in sys.modules
    exec(ARE_READINGS, {})


DESCRIBED = PAPER_LIMITS.to_dict()


def test_limits_come_back_as_they_were_described():
    assert Limits.of(DESCRIBED) == PAPER_LIMITS
    widest = {"angle_min_rad": -2 * math.pi, "velocity_max_rad_s": 50}
    assert Limits.of(DESCRIBED | widest).velocity_max == 50


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angle_max_rad": 100.0}, "limits: angle_max_rad is 100"),
        ({"velocity_max_rad_s": 9000.0}, "velocity_max_rad_s is 9000; .* 50 rad/s"),
        ({"velocity_min_rad_s": -1}, "velocity_min_rad_s is -1"),
        ({"angle_min_rad": math.nan}, "angle_min_rad is nan"),
        ({"velocity_max_rad_s": math.inf}, "velocity_max_rad_s is inf"),
        ({"angle_min_rad": 2.0}, "angle_min_rad is 2, angle_max_rad is 1.5708"),
        ({"velocity_min_rad_s": math.tau}, "velocity_min <= velocity_max"),
        ({"angle_min_rad": "0"}, "angle_min_rad is '0'"),
        ({"angle_min_rad": None}, "angle_min_rad is missing"),
        ({"velocity_max_rad_s": True}, "velocity_max_rad_s is True"),
        ({"angle_max_rad": 10**400}, "angle_max_rad is 10{79}; "),
    ],
)
def test_limits_that_no_fin_has_are_refused_with_what_is_allowed(changes, words):
    with pytest.raises(ValueError, match=words):
        Limits.of({**DESCRIBED, **changes})


@pytest.mark.parametrize(
    ("low", "high", "rest"),
    [(-1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.2, 1.2, 0.2), (-1.5, -0.3, -0.3)],
)
def test_a_fin_rests_at_0_or_at_the_end_of_its_range_closest_to_it(low, high, rest):
    limits = Limits(low, high, 1.0, 2.0)
    assert limits.problem() is None
    assert limits.rest_angle == rest
    assert action_to_command(limits, rest_action(limits)).angle == pytest.approx(rest, abs=1e-9)
    assert float(rest_command(limits).angle) == pytest.approx(rest)


def test_a_fin_may_have_one_velocity_but_not_0():
    limits = PAPER_LIMITS._replace(velocity_min=2.0, velocity_max=2.0)
    assert limits.problem() is None
    still = PAPER_LIMITS._replace(velocity_min=0.0, velocity_max=0.0)
    assert "0 < velocity_max" in (still.problem() or "")


def log_of_commands(*angles):
    zeros = np.zeros(len(angles), np.float32)
    command = Command(np.array(angles, np.float32), zeros + 2)
    return Log(command, Reading(zeros, zeros, zeros, np.zeros((len(angles), 2))))


@pytest.mark.parametrize(
    ("angles", "ends"),
    [
        ((-0.5, 0.25), (-0.5, 0.25)),
        ((0.02, 0.5), (0.0, 0.5)),
        ((-0.5, -0.02), (-0.5, 0.0)),
        ((0.25, 0.5), (0.25, 0.5)),
    ],
)
def test_a_range_of_commands_that_ends_near_rest_ends_there(angles, ends):
    limits = command_limits([log_of_commands(angles[0]), log_of_commands(angles[1])])
    assert limits == Limits(*ends, 2.0, 2.0)
    assert limits.problem() is None


@pytest.mark.parametrize(
    ("time_s", "tick"),
    [(0.01, 1), (12.344, 1234), (86_399.99, 8_639_999), (1.7e9, 8_000_000), (-0.5, 8_639_950)],
)
def test_ticks_are_counted_within_the_day_whenever_the_clock_began(time_s, tick):
    assert tick_at(time_s) == tick
