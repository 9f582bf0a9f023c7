import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import CommandError, LogError
from softfin.core.plant import rest_command, roll
from softfin.core.quantities import Command
from softfin.surrogate import StreamingSurrogate
from softfin.surrogate.streaming.ensemble import parameters, single
from softfin.surrogate.streaming.segments import MAX_DELAY
from softfin.testing import check_surrogate
from tests.surrogate.streaming import small

PLANT = small.surrogate()
STROKE = Command(jnp.float32(0.7), jnp.float32(2.0))
START = PLANT.init(jax.random.key(0))


@pytest.fixture(scope="module")
def advance():
    """Two programs for all: of one tick, and of 33."""
    return jax.jit(
        lambda state, command, ticks: PLANT.advance(state, command, ticks), static_argnums=2
    )


def test_a_streaming_surrogate_meets_the_contract():
    check_surrogate(PLANT)


def test_33_ticks_are_33_times_one(advance):
    held_state, held = advance(START, STROKE, 33)
    state = START
    each = []
    for _ in range(33):
        state, reading = advance(state, STROKE, 1)
        each.append(reading)
    for one, other in zip(held, jax.tree.map(lambda *x: np.concatenate(x), *each), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    for one, other in zip(*map(jax.tree.leaves, (held_state, state)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_readings_are_the_mean_of_the_members_who_disagree(advance):
    _, mean = advance(START, STROKE, 33)
    _, each = jax.jit(lambda state: PLANT.advance_members(state, STROKE, 33))(START)
    assert each.force.shape == (2, 33, 2)
    for one, other in zip(mean, each, strict=True):
        np.testing.assert_allclose(one, np.asarray(other).mean(axis=0), atol=1e-6)
    assert np.abs(each.force[0] - each.force[1]).max() > 0.1


def test_the_state_does_not_grow_with_what_it_remembers():
    def shapes(ticks):
        after, _ = jax.eval_shape(lambda state: PLANT.advance(state, STROKE, ticks), START)
        return [leaf.shape for leaf in jax.tree.leaves(after)]

    assert shapes(10) == shapes(1000) == [leaf.shape for leaf in jax.tree.leaves(START)]


def test_it_begins_at_rest_and_stays_there_until_it_is_told_otherwise(advance):
    after = START
    parts = []
    for _ in range(3):
        after, part = advance(after, rest_command(PLANT.limits), 33)
        parts.append(part)
    for each, atol in (("force", 1e-4), ("angle", 1e-5), ("velocity", 1e-5)):
        values = np.concatenate([getattr(part, each) for part in parts])
        np.testing.assert_allclose(values, np.repeat(values[:1], 99, axis=0), atol=atol)
    for one, other in zip(
        *(jax.tree.leaves(state.members) for state in (START, after)), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert float(parts[0].time[0]) == pytest.approx(0.01)


PAST = 360
LOG = small.recorded(400, seed=5)


def test_warm_is_where_following_the_log_from_there_on_comes_to():
    begin = PAST - PLANT.memory + MAX_DELAY
    # Held before that row, as `predict_logs` takes it to have been.
    held = Command(*(np.where(np.arange(400) < begin, part[begin], part) for part in LOG.command))
    log = LOG._replace(command=held)
    ahead = jax.tree.map(jnp.asarray, small.valid_rows(held, PAST - 1, 399))
    _, reading = roll(PLANT, PLANT.warm(small.valid_rows(log, 0, PAST)), ahead)
    (said,) = small.predict_logs(PLANT.members, [small.valid_rows(log, begin, None)])
    np.testing.assert_allclose(reading.angle, said.motion.angle.mean(axis=0)[-40:], atol=1e-5)
    np.testing.assert_allclose(reading.force, said.force.mean(axis=0)[-40:], atol=1e-4)


def test_warm_counts_on_from_the_time_of_the_last_row_and_sees_only_its_memory(advance):
    long = PLANT.warm(LOG)
    short = PLANT.warm(small.valid_rows(LOG, 400 - PLANT.memory, None))
    assert all(
        np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (long, short)), strict=True)
    )
    _, reading = advance(long, STROKE, 1)
    assert float(reading.time[0]) == pytest.approx(float(LOG.reading.time[-1]) + 0.01)


def test_warm_takes_a_unix_clock_and_counts_within_its_day(advance):
    unix = LOG._replace(reading=LOG.reading._replace(time=1.7e9 + np.arange(400) / 100))
    _, reading = advance(PLANT.warm(unix), STROKE, 1)
    assert float(reading.time[0]) == pytest.approx(1.7e9 % 86400 + 4, abs=0.01)


def test_a_short_history_is_refused():
    with pytest.raises(LogError, match="history: 299 rows; this surrogate needs 300 rows"):
        PLANT.warm(small.valid_rows(LOG, 101, None))


def test_a_command_outside_the_limits_is_refused():
    state = PLANT.init(jax.random.key(0))
    with pytest.raises(CommandError, match="the plant accepts"):
        PLANT.advance(state, Command(3.0, 3.0), 1)


def test_parameters_are_those_of_all_members():
    member = single(PLANT.members)
    assert (
        PLANT.parameters()
        == sum(leaf.size for leaf in jax.tree.leaves(PLANT.members))
        == 2 * parameters(member)
    )
    assert (PLANT.model, PLANT.size) == ("streaming", 2)


def test_a_mirrored_fin_says_mirrored_readings():
    members = small.eqx.tree_at(
        lambda m: small.MOUNT(m.force), PLANT.members, replace_fn=jnp.zeros_like
    )
    plant = StreamingSurrogate(members, PLANT.limits, PLANT.interval, PLANT.familiarity)
    issued = Command(*map(jnp.asarray, small.commands(200, seed=2)))
    start = plant.init(jax.random.key(0))
    rolled = jax.jit(lambda commands: roll(plant, start, commands)[1])
    both = [rolled(one) for one in (issued, issued._replace(angle=-issued.angle))]
    np.testing.assert_allclose(both[1].angle, -both[0].angle, atol=1e-5)
    np.testing.assert_allclose(both[1].force, small.mirrored(both[0].force), atol=1e-3)


def test_the_distance_is_that_of_the_first_members_force_net(advance):
    state, _ = advance(START, STROKE, 33)
    memory = np.concatenate(
        [np.ravel(leaf[0]) for leaf in jax.tree.leaves(state.members.force[:2])]
    )
    assert float(PLANT.distance(state)) == pytest.approx(np.linalg.norm(memory), rel=1e-4)
