"""Running normalisation: the statistics are those of all that was seen, and no gradient reaches
them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.learning.layers import MIN_DEVIATION, Normalisation
from softfin.learning.policy import Critic, Policy, PolicyConfig

SMALL = PolicyConfig(units=8, width=8)
ROWS = (1, 7, 30)


updated = jax.jit(Normalisation.updated)
create = jax.jit(lambda: Policy.create(jax.random.key(0), SMALL, 4))
create_critic = jax.jit(lambda: Critic.create(jax.random.key(0), 4, 8))


def samples(seed: int, rows: int, mean: float = 3.0, deviation: float = 2.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, deviation, (rows, 4)).astype(np.float32)


def test_nothing_is_changed_at_the_start() -> None:
    x = samples(0, 5)
    read, undone = jax.jit(
        lambda x: (Normalisation.create(4)(x), Normalisation.create(4).inverse(x))
    )(x)
    np.testing.assert_array_equal(read, x)
    np.testing.assert_array_equal(undone, x)


@settings(max_examples=10, deadline=None)
@given(sizes=st.lists(st.sampled_from(ROWS), min_size=1, max_size=4), mean=st.floats(-5, 5))
def test_batches_give_the_statistics_of_all_their_vectors(sizes: list[int], mean: float) -> None:
    batches = [samples(i, rows, mean * i, 1.0 + i) for i, rows in enumerate(sizes)]
    normalisation = Normalisation.create(4)
    for batch in batches:
        normalisation = updated(normalisation, batch)
    together = np.concatenate(batches)
    np.testing.assert_allclose(normalisation.mean, together.mean(axis=0), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(normalisation.std, together.std(axis=0), rtol=1e-3, atol=1e-3)
    assert float(normalisation.count) == len(together)


def test_what_was_normalised_comes_back_and_has_mean_0_and_deviation_1() -> None:
    x = samples(1, 500)

    @jax.jit
    def there_and_back(x: Any) -> Any:
        normalisation = Normalisation.create(4).updated(x)
        y = normalisation(x)
        return y, normalisation.inverse(y)

    y, again = map(np.asarray, there_and_back(x))
    np.testing.assert_allclose(y.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(y.std(axis=0), 1, atol=1e-3)
    np.testing.assert_allclose(again, x, atol=1e-4)


def test_a_number_that_never_varied_is_not_blown_up_later() -> None:
    read = jax.jit(lambda seen, x: Normalisation.create(1).updated(seen)(x))
    same, more = np.asarray(read(np.full((100, 1), 0.7, np.float32), np.float32([[0.7], [0.8]])))
    np.testing.assert_allclose(same, 0, atol=1e-5)
    np.testing.assert_allclose(more, 0.1 / MIN_DEVIATION, rtol=1e-4)


def test_old_vectors_weigh_no_more_than_asked() -> None:
    old = samples(2, 1000, mean=-8)
    new = samples(3, 50, mean=2)
    forgets = jax.jit(lambda old, new: Normalisation.create(4).updated(old).updated(new, 50))(
        old, new
    )
    np.testing.assert_allclose(forgets.mean, (old.mean(axis=0) + new.mean(axis=0)) / 2, atol=1e-3)
    assert float(forgets.count) == 100


def test_no_gradient_reaches_the_statistics_of_a_policy_and_all_weights_have_one() -> None:
    def loss(policy: Policy) -> jax.Array:
        memory, action = policy.act(policy.init(), jnp.ones(4))
        mean = policy.sequence(policy.init(), jnp.asarray(samples(5, 6)), jnp.zeros(6, bool))
        return (
            action.sum() + mean.sum() + policy.log_prob(mean, mean + 1).sum() + memory.hidden.sum()
        )

    slope = jax.jit(lambda policy, seen: jax.grad(loss)(policy.update_statistics(seen)))(
        create(), samples(4, 20)
    )
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(slope.normalisation))
    assert all(np.any(leaf) for leaf in jax.tree.leaves((slope.net, slope.log_std)))


def test_a_policy_reads_its_observations_normalised_step_by_step_as_in_sequence() -> None:
    x = samples(6, 20)

    @jax.jit
    def said(fresh: Policy, x: Any, scaled: Any) -> Any:
        policy = fresh.update_statistics(x)
        along = policy.sequence(policy.init(), x, jnp.zeros(20, bool))
        return policy.step(policy.init(), x[0])[1], fresh.step(fresh.init(), scaled)[1], along[0]

    mean, plain, first = said(create(), x, (x[0] - x.mean(axis=0)) / x.std(axis=0))
    np.testing.assert_allclose(mean, plain, atol=1e-5)
    np.testing.assert_allclose(first, mean, atol=1e-5)


def test_a_critic_says_the_same_in_its_new_unit_and_learns_in_it() -> None:
    seen = samples(7, 200)
    target = samples(8, 200, -50, 9)[:, 0]

    @jax.jit
    def said(critic: Critic, seen: Any, target: Any) -> Any:
        turned = critic.update_statistics(seen, target, 1000)
        same_inputs = eqx.tree_at(lambda c: c.inputs, turned, critic.inputs)
        return critic(seen), same_inputs(seen), turned(seen), turned.loss(seen, target)

    before, same_inputs, turned, loss = map(np.asarray, said(create_critic(), seen, target))
    np.testing.assert_allclose(same_inputs, before, atol=1e-3)
    np.testing.assert_allclose(loss, np.mean(((turned - target) / target.std()) ** 2), rtol=1e-3)


def test_no_gradient_reaches_the_statistics_of_a_critic() -> None:
    seen = samples(9, 50)
    target = np.linspace(-3, 1, 50, dtype=np.float32)

    @jax.jit
    def slope_of(critic: Critic, seen: Any, target: Any) -> Any:
        return jax.grad(lambda critic: critic.loss(seen, target))(
            critic.update_statistics(seen, target, 100)
        )

    slope = slope_of(create_critic(), seen, target)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves((slope.inputs, slope.values)))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(slope.layers))
