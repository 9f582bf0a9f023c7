import equinox as eqx
import jax
import numpy as np
import pytest

from softfin.surrogate.streaming.ensemble import motions, predict_force, predict_motion, single
from tests.surrogate.streaming import small

MEMBERS = small.members()
LOGS = [small.recorded(rows, seed) for seed, rows in enumerate((70, 50, 70))]


@pytest.fixture(scope="module")
def together():
    return small.predict_logs(MEMBERS, LOGS)


def test_logs_of_any_lengths_side_by_side_are_those_one_by_one(together):
    for log, said in zip(LOGS, together, strict=True):
        (alone,) = small.predict_logs(MEMBERS, [log])
        assert alone.force.shape == (2, len(log.reading.time), 2)
        for one, other in zip(
            jax.tree.leaves(vars(alone)), jax.tree.leaves(vars(said)), strict=True
        ):
            np.testing.assert_allclose(one, other, atol=1e-5)


def test_each_member_is_predicted_by_itself(together):
    second = single(MEMBERS, 1)
    before = small.rows_of_first(LOGS[1])
    waiting = jax.tree.map(lambda x: np.full(20, x[0], np.float32), LOGS[1].command)
    alone = eqx.filter_jit(motions)(
        second.drive, before, waiting, small.valid_rows(LOGS[1].command, 0, -1)
    )
    np.testing.assert_allclose(together[1].motion.angle[1], alone.angle, atol=1e-5)
    assert np.abs(together[1].force[0] - together[1].force[1]).max() > 0.1


def test_the_first_row_is_the_measured_one_and_its_force_that_of_the_second(together):
    for log, said in zip(LOGS, together, strict=True):
        np.testing.assert_array_equal(said.motion.angle[:, 0], np.full(2, log.reading.angle[0]))
        np.testing.assert_array_equal(
            said.motion.velocity[:, 0], np.full(2, log.reading.velocity[0])
        )
        np.testing.assert_array_equal(said.force[:, 0], said.force[:, 1])


def test_forces_follow_from_the_motion_that_is_given():
    (motion,) = predict_motion(MEMBERS.drive, LOGS[:1])
    (force,) = predict_force(MEMBERS.force, [motion])
    (whole,) = small.predict_logs(MEMBERS, LOGS[:1])
    np.testing.assert_allclose(force, whole.force, atol=1e-6)
    (other,) = predict_force(MEMBERS.force, [jax.tree.map(lambda x: -x, motion)])
    assert np.abs(other - force).max() > 0.1
