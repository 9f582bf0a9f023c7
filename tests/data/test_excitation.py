import jax
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.data.excitation import ExcitationConfig


def holds(values: np.ndarray) -> np.ndarray:
    """The lengths of the stretches of equal value, without the last, which the end of the log
    cuts."""
    return np.diff(np.flatnonzero(np.r_[True, np.diff(values) != 0]))


def test_targets_fill_the_limits_evenly():
    command = ExcitationConfig(hold_min_s=0.01, hold_max_s=0.02)(
        jax.random.key(0), 200_000, PAPER_LIMITS
    )
    for values, low, high in (
        (command.angle, PAPER_LIMITS.angle_min, PAPER_LIMITS.angle_max),
        (command.velocity, PAPER_LIMITS.velocity_min, PAPER_LIMITS.velocity_max),
    ):
        assert low <= values.min() < low + 0.01
        assert high - 0.01 < values.max() <= high
        share = np.histogram(values, bins=10, range=(low, high))[0] / values.size
        np.testing.assert_allclose(share, 0.1, atol=0.005)


def test_every_hold_lies_between_the_shortest_and_the_longest():
    command = ExcitationConfig(hold_min_s=0.2, hold_max_s=0.5)(
        jax.random.key(1), 100_000, PAPER_LIMITS
    )
    lengths = holds(np.asarray(command.angle))
    assert lengths.min() == 20
    assert lengths.max() == 50
    assert abs(lengths.mean() - 35) < 0.5


def test_angle_and_velocity_change_together():
    command = ExcitationConfig()(jax.random.key(2), 5000, PAPER_LIMITS)
    np.testing.assert_array_equal(np.diff(command.angle) != 0, np.diff(command.velocity) != 0)


def test_commands_last_to_the_end_even_when_every_hold_is_the_shortest():
    command = ExcitationConfig(hold_min_s=0.2, hold_max_s=0.2)(
        jax.random.key(3), 1000, PAPER_LIMITS
    )
    assert (holds(np.asarray(command.angle)) == 20).all()
    assert len(np.unique(command.angle)) == 50


def test_the_limits_of_the_plant_are_kept():
    limits = Limits(0.1, 0.2, 2.0, 2.5)
    command = ExcitationConfig()(jax.random.key(4), 2000, limits)
    assert command.angle.min() >= 0.1
    assert command.angle.max() <= 0.2
    assert command.velocity.min() >= 2.0
    assert command.velocity.max() <= 2.5


@pytest.mark.parametrize("values", [{"hold_min_s": 0.5, "hold_max_s": 0.3}, {"hold_min_s": 0.205}])
def test_holds_that_make_no_sense_are_refused(values):
    with pytest.raises(ConfigurationError, match="hold_min_s"):
        ExcitationConfig.build(values)
