"""The policy: actions, densities, weights by name."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.learning.policy import Policy, PolicyConfig, name_policy_arrays

CONFIG = PolicyConfig(units=8, width=6)


act = jax.jit(lambda policy, observation: policy.act(policy.init(), observation)[1])


@pytest.fixture(scope="module")
def policy() -> Policy:
    made: Policy = jax.jit(lambda: Policy.create(jax.random.key(0), CONFIG, 11))()
    return made


def weights(tree: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in name_policy_arrays(tree).items()}


def test_the_deterministic_action_is_within_the_box_and_has_no_noise(policy: Policy) -> None:
    loud = jax.tree.map(lambda x: 50 * np.asarray(x), policy)
    action = np.asarray(act(loud, np.ones(11, np.float32)))
    assert np.all(np.abs(action) <= 1)
    np.testing.assert_array_equal(action, act(loud, np.ones(11, np.float32)))


def test_a_policy_steps_as_its_sequence_runs(policy: Policy) -> None:
    x = np.random.default_rng(1).normal(size=(9, 11)).astype(np.float32)
    memory = policy.init()
    means = []
    step = jax.jit(lambda policy, *now: policy.step(*now))
    for observation in x:
        memory, mean = step(policy, memory, observation)
        means.append(np.asarray(mean))
    along = jax.jit(lambda policy, x: policy.sequence(policy.init(), x, jnp.zeros(9, bool)))(
        policy, x
    )
    np.testing.assert_allclose(along, np.stack(means), atol=1e-6)


def test_the_density_is_that_of_a_normal_distribution(policy: Policy) -> None:
    deviation = np.array([0.5, 2.0])
    policy = Policy(policy.net, jnp.log(jnp.float32(deviation)), policy.normalisation)
    mean = np.array([0.3, -1.0])
    raw = np.array([0.1, 0.7])
    density = np.exp(-0.5 * ((raw - mean) / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(
        policy.log_prob(jnp.float32(mean), jnp.float32(raw)), np.log(density).sum(), rtol=1e-5
    )
    entropy = np.log(deviation * np.sqrt(2 * np.pi * np.e)).sum()
    np.testing.assert_allclose(policy.action_entropy(), entropy, rtol=1e-5)


def test_weights_and_normalisation_go_by_name(policy: Policy) -> None:
    seen = np.random.default_rng(2).normal(size=(5, 11)).astype(np.float32)
    policy = jax.jit(Policy.update_statistics)(policy, seen)
    arrays = weights(policy)
    assert {"net.lstm.kernel", "net.output.bias", "log_std", "normalisation.mean"} <= set(arrays)
    np.testing.assert_array_equal(arrays["normalisation.std"], policy.normalisation.std)
