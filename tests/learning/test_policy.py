"""The policy: actions, densities, weights by name."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.policy import PolicyObservation, fold, phases
from softfin.control.single import SingleStep
from softfin.core.operations import NUMPY
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.gait import GaitTable
from softfin.gaits.reachable import Cell
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
    policy = Policy(policy.net, jnp.log(jnp.float32(deviation)), policy.normalisation, None)
    mean = np.array([0.3, -1.0])
    raw = np.array([0.1, 0.7])
    density = np.exp(-0.5 * ((raw - mean) / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(
        policy.log_prob(jnp.float32(mean), jnp.float32(raw)), np.log(density).sum(), rtol=1e-5
    )
    entropy = np.log(deviation * np.sqrt(2 * np.pi * np.e)).sum()
    np.testing.assert_allclose(policy.action_entropy(), entropy, rtol=1e-5)


OBSERVATION = PolicyObservation(phase=True)
GAITS = GaitTable(
    np.array([-1, -1], np.float32),
    np.array([1, 1], np.float32),
    np.random.default_rng(5).uniform(-0.9, 0.9, (2, 2, 6, 2)).astype(np.float32),
)
"""Over references in units of the observation."""


def observed(reference: Any, age: int) -> np.ndarray:
    seen = np.zeros(OBSERVATION.size, np.float32)
    seen[1:3], seen[-2:] = reference, phases(6)[age % 6]
    return seen


@pytest.fixture(scope="module")
def with_gaits() -> Policy:
    return Policy.create(jax.random.key(1), CONFIG, OBSERVATION.size, gaits=GAITS)


def test_a_policy_with_gaits_begins_nearly_as_the_gait_of_the_reference_in_its_phase(
    with_gaits: Policy,
) -> None:
    for age in range(7):
        action = np.asarray(act(with_gaits, observed((0.4, -0.3), age)))
        np.testing.assert_allclose(action, GAITS.gait((0.4, -0.3))[age % 6], atol=0.02)


def test_no_slope_reaches_the_gaits(with_gaits: Policy) -> None:
    seen = jnp.asarray(observed((0.4, -0.3), 2))
    slope = jax.jit(jax.grad(lambda policy: policy.act(policy.init(), seen)[1].sum()))(with_gaits)
    assert not any(np.any(leaf) for leaf in slope.gaits)
    assert np.any(slope.net.output.kernel)


def test_a_stored_policy_with_gaits_acts_the_same_on_a_robot(with_gaits: Policy) -> None:
    arrays = weights(with_gaits)
    limits = PAPER_LIMITS
    step, _ = SingleStep.load(
        {"task": OBSERVATION.model_dump()}, arrays, limits, (Cell.around((0, 0)),)
    )
    state = step.init()
    memory = with_gaits.init()
    advance = jax.jit(Policy.act)
    for age, reference in enumerate(
        np.random.default_rng(6).uniform(-1, 1, (9, 2)).astype(np.float32)
    ):
        seen = observed(reference, age)
        seen[3:-2] = state.actions[: len(seen) - 5]
        memory, expected = advance(with_gaits, memory, seen)
        now = np.array([0, *reference * OBSERVATION.force_scale_n], np.float32)
        state, action = step.act(NUMPY, state, now)
        np.testing.assert_allclose(action, expected, atol=1e-5)


def test_damaged_gaits_of_a_policy_are_refused(with_gaits: Policy) -> None:
    broken = weights(with_gaits) | {"gaits.actions": np.zeros((2, 2, 5, 2), np.float32)}
    with pytest.raises(ValueError, match=r"gaits: got actions of shape \(2, 2, 5, 2\)"):
        fold(broken, OBSERVATION)
    with pytest.raises(ValueError, match=r"2 x 2 nodes and actions within \[-1, 1\]"):
        fold(weights(with_gaits) | {"gaits.actions": 2 * np.ones((2, 2, 6, 2))}, OBSERVATION)
    missing = {name: array for name, array in weights(with_gaits).items() if name != "gaits.high"}
    with pytest.raises(ValueError, match=r"gaits: got gaits\.actions, gaits\.low; must be"):
        fold(missing, OBSERVATION)
    with pytest.raises(
        ValueError, match=r"task\.phase is false; must be true for a policy with gaits"
    ):
        fold(weights(with_gaits), PolicyObservation())


def test_weights_and_normalisation_go_by_name(policy: Policy) -> None:
    seen = np.random.default_rng(2).normal(size=(5, 11)).astype(np.float32)
    policy = jax.jit(Policy.update_statistics)(policy, seen)
    arrays = weights(policy)
    assert {"net.lstm.kernel", "net.output.bias", "log_deviation", "normalisation.mean"} <= set(
        arrays
    )
    np.testing.assert_array_equal(arrays["normalisation.deviation"], policy.normalisation.std)
