"""Running normalisation: the statistics are those of all that was seen, and no gradient reaches them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.training.normalisation import LEAST_DEVIATION, Normalisation
from softfin.training.policy import Critic, Policy, PolicyConfig

SMALL = PolicyConfig(units=8, width=8)


def samples(seed: int, rows: int, mean: float = 3.0, deviation: float = 2.0) -> jax.Array:
    return mean + deviation * jax.random.normal(jax.random.key(seed), (rows, 4))


def test_nothing_is_changed_at_the_start() -> None:
    x = samples(0, 5)
    np.testing.assert_array_equal(Normalisation.create(4)(x), x)
    np.testing.assert_array_equal(Normalisation.create(4).undone(x), x)


@settings(max_examples=10, deadline=None)
@given(sizes=st.lists(st.integers(1, 30), min_size=1, max_size=4), mean=st.floats(-5, 5))
def test_batches_give_the_statistics_of_all_their_vectors(sizes: list[int], mean: float) -> None:
    batches = [samples(i, rows, mean * i, 1.0 + i) for i, rows in enumerate(sizes)]
    normalisation = Normalisation.create(4)
    for batch in batches:
        normalisation = normalisation.updated(batch)
    together = np.concatenate(batches)
    np.testing.assert_allclose(normalisation.mean, together.mean(axis=0), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(normalisation.deviation, together.std(axis=0), rtol=1e-3, atol=1e-3)
    assert float(normalisation.count) == len(together)


def test_what_was_normalised_comes_back_and_has_mean_0_and_deviation_1() -> None:
    x = samples(1, 500)
    normalisation = Normalisation.create(4).updated(x)
    y = normalisation(x)
    np.testing.assert_allclose(y.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(y.std(axis=0), 1, atol=1e-3)
    np.testing.assert_allclose(normalisation.undone(y), x, atol=1e-4)


def test_a_number_that_never_varied_is_not_blown_up_later() -> None:
    normalisation = Normalisation.create(1).updated(jnp.full((100, 1), 0.7))
    np.testing.assert_allclose(normalisation(jnp.array([0.7])), 0, atol=1e-5)
    np.testing.assert_allclose(normalisation(jnp.array([0.8])), 0.1 / LEAST_DEVIATION, rtol=1e-4)


def test_old_vectors_weigh_no_more_than_asked() -> None:
    old, new = samples(2, 1000, mean=-8), samples(3, 50, mean=2)
    forgets = Normalisation.create(4).updated(old).updated(new, 50)
    np.testing.assert_allclose(forgets.mean, (old.mean(axis=0) + new.mean(axis=0)) / 2, atol=1e-3)
    assert float(forgets.count) == 100


def test_no_gradient_reaches_the_statistics_of_a_policy_and_all_weights_have_one() -> None:
    policy = Policy.create(jax.random.key(0), SMALL, 4).having_seen(samples(4, 20))

    def loss(policy: Policy) -> jax.Array:
        memory, action = policy.act(policy.init(), jnp.ones(4))
        mean = policy.sequence(policy.init(), samples(5, 6), jnp.zeros(6, bool))
        return action.sum() + mean.sum() + policy.log_density(mean, mean + 1).sum() + memory.hidden.sum()

    slope = jax.grad(loss)(policy)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(slope.normalisation))
    assert all(np.any(leaf) for leaf in jax.tree.leaves((slope.net, slope.log_deviation)))


def test_a_policy_reads_its_observations_normalised_step_by_step_as_in_sequence() -> None:
    fresh = Policy.create(jax.random.key(0), SMALL, 4)
    x = samples(6, 20)
    policy = fresh.having_seen(x)
    _, mean = policy.step(policy.init(), x[0])
    _, plain = fresh.step(fresh.init(), (x[0] - x.mean(axis=0)) / x.std(axis=0))
    np.testing.assert_allclose(mean, plain, atol=1e-5)
    np.testing.assert_allclose(policy.sequence(policy.init(), x, jnp.zeros(20, bool))[0], mean, atol=1e-5)


def test_a_critic_says_the_same_in_its_new_unit_and_learns_in_it() -> None:
    critic = Critic.create(jax.random.key(0), 4, 8)
    seen, target = samples(7, 200), -50 + 9 * jax.random.normal(jax.random.key(8), (200,))
    turned = critic.having_seen(seen, target, 1000)
    same_inputs = eqx.tree_at(lambda c: c.reads, turned, critic.reads)
    np.testing.assert_allclose(same_inputs(seen), critic(seen), atol=1e-3)
    expected = np.mean(np.asarray((turned(seen) - target) / target.std()) ** 2)
    np.testing.assert_allclose(turned.loss(seen, target), expected, rtol=1e-3)


def test_no_gradient_reaches_the_statistics_of_a_critic() -> None:
    seen, target = samples(9, 50), jnp.linspace(-3, 1, 50)
    critic = Critic.create(jax.random.key(0), 4, 8).having_seen(seen, target, 100)
    slope = jax.grad(lambda critic: critic.loss(seen, target))(critic)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves((slope.reads, slope.says)))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(slope.layers))
