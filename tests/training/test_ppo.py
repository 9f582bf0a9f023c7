"""PPO learns what each probe asks."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.errors import ConfigurationError
from softfin.training.lstm import Memory
from softfin.training.policy import ActorCritic, Policy
from softfin.training.ppo import PPO, Lane, PPOConfig
from softfin.training.rollout import Rollout, collect
from softfin.training.score import score
from tests.training.probes import Delayed, Direct, Late, Recall, Still, box, learner


def trained(ppo: PPO, references: Any, seed: int = 0) -> Lane:
    @jax.jit
    def run(key: Any) -> Lane:
        lane = ppo.init(key, references)
        return jax.lax.scan(lambda lane, _: (ppo.update(lane)[0], None), lane, None, ppo.updates)[0]

    return run(jax.random.key(seed))


def errors(ppo: PPO, policy: Policy, references: list[tuple[float, float]]) -> np.ndarray:
    """Deterministic, for each reference 16 fins with keys of their own."""
    at = jnp.repeat(jnp.asarray(references, jnp.float32), 16, axis=0)
    return np.asarray(jax.jit(lambda p: score(ppo.task, p, at, jax.random.key(7)).error)(policy))


def test_the_action_that_makes_the_reference_is_learnt_for_every_reference() -> None:
    ppo = learner(Direct(), updates=60, episode=6, rollout_actions=6)
    references = [(-2.0, 1.5), (2.0, 2.5), (0.0, 2.0)]
    lane = trained(ppo, box((-3, 1.5), (3, 2.5)))
    assert errors(ppo, lane.networks.policy, references).mean() < 0.15
    assert errors(ppo, ppo.init(jax.random.key(0), box((-3, 1.5), (3, 2.5))).networks.policy, references).mean() > 0.5


def test_an_action_whose_effect_comes_one_action_later_is_learnt() -> None:
    ppo = learner(Delayed(), updates=60, episode=6, learning_rate=1e-2, rollout_actions=6)
    lane = trained(ppo, box((2, 2), (2, 2)))
    assert errors(ppo, lane.networks.policy, [(2, 2)]).mean() < 0.5


def test_the_value_of_a_constant_reward_is_that_reward() -> None:
    ppo = learner(Still(), updates=40, episode=6, rollout_actions=6, learning_rate=1e-2)
    lane = trained(ppo, box((4, -3), (4, -3)))
    np.testing.assert_allclose(values(ppo, lane)[1:], -7, atol=0.3)


def values(ppo: PPO, lane: Lane) -> np.ndarray:
    """What the critic says along an episode, mean over the fins."""

    def along(lane: Lane) -> Any:
        again = jax.vmap(ppo.task.reset)(lane.batch.states.key, lane.batch.states.references)
        batch = lane.batch._replace(states=again, fresh=jnp.ones_like(lane.batch.fresh))
        rollout = collect(ppo.task, lane.networks.policy, batch, jax.random.key(0), 2)[1]
        return lane.networks.critic(rollout.seen).mean(axis=1)

    return np.asarray(jax.jit(along)(lane))


def test_values_ahead_of_a_change_are_discounted() -> None:
    ppo = learner(Late(), updates=40, episode=12, learning_rate=1e-2, discount=0.5)
    lane = trained(ppo, box((1, 0), (1, 0)))
    np.testing.assert_allclose(values(ppo, lane), [-(1 - 0.5**3), -(1 - 0.5**2), -0.5, 0, 0, 0], atol=0.05)


class Blind(Policy):
    """It does not see its past actions: into these, a policy without memory writes notes to itself."""

    def step(self, memory: Memory, observation: Any) -> Any:
        return Policy.step(self, memory, observation.at[3:].set(0))

    def sequence(self, memory: Memory, observation: Any, fresh: Any) -> Any:
        return Policy.sequence(self, memory, observation.at[:, 3:].set(0), fresh)


class Forgetful(Blind):
    """And its memory is cleared at every step."""

    def step(self, memory: Memory, observation: Any) -> Any:
        return Blind.step(self, self.init(), observation)

    def sequence(self, memory: Memory, observation: Any, fresh: Any) -> Any:
        return Blind.sequence(self, memory, observation, jnp.ones_like(fresh))


def became(policy: Policy, kind: type[Policy]) -> Policy:
    return kind(policy.net, policy.log_deviation, policy.normalisation)


def recalled(kind: type[Policy]) -> tuple[PPO, Policy]:
    """A policy of a kind, trained on `Recall`."""

    class Playing(PPO):
        def init(self, key: Any, references: Any) -> Lane:
            lane = PPO.init(self, key, references)
            networks = ActorCritic(became(lane.policy, kind), lane.networks.critic)
            return lane._replace(networks=networks, policy=networks.policy, optimiser=self._optimiser().init(networks))

    plain = learner(Recall(), updates=60, learning_rate=5e-3)
    ppo = Playing(plain.task, plain.config, plain.policy, plain.updates)
    policy = trained(ppo, box((2, 0), (2, 0))).networks.policy
    assert type(policy) is kind
    return ppo, policy


def test_a_task_that_needs_memory_is_learnt_with_it() -> None:
    ppo, policy = recalled(Blind)
    assert errors(ppo, policy, [(2, 0)])[:, 0].mean() < 0.5
    assert errors(ppo, became(policy, Forgetful), [(2, 0)])[:, 0].mean() > 1.5


def test_a_task_that_needs_memory_is_not_learnt_without_it() -> None:
    ppo, policy = recalled(Forgetful)
    assert errors(ppo, policy, [(2, 0)])[:, 0].mean() > 1.5


class Updated(NamedTuple):
    ppo: PPO
    before: Lane
    after: Lane
    rollout: Rollout
    """That it learnt from."""


@pytest.fixture(scope="module")
def updated() -> Updated:
    """A lane before and after its first update."""
    ppo = learner(Direct(), updates=4, episode=6, rollout_actions=6, epochs=2, averaging=3.0)

    def run(key: Any) -> tuple[Lane, Lane, Rollout]:
        before = ppo.init(key, box((-3, 1.5), (3, 2.5)))
        play, _, _ = jax.random.split(before.key, 3)
        rollout = collect(ppo.task, before.networks.policy, before.batch, play, 2)[1]
        return before, ppo.update(before)[0], rollout

    return Updated(ppo, *jax.jit(run)(jax.random.key(0)))


def test_the_policy_reads_in_units_of_what_its_fins_observed(updated: Updated) -> None:
    seen = np.asarray(updated.rollout.observation).reshape(updated.ppo.config.steps_per_update, -1)
    for policy in (updated.after.networks.policy, updated.after.policy):
        np.testing.assert_allclose(policy.normalisation.mean, seen.mean(axis=0), atol=1e-3)
        np.testing.assert_allclose(policy.normalisation.deviation, seen.std(axis=0), atol=1e-3)
        assert float(policy.normalisation.count) == len(seen)


def test_without_normalisation_nothing_is_scaled() -> None:
    ppo = learner(Direct(), updates=4, episode=6, rollout_actions=6, epochs=2, normalise=False)
    lane = jax.jit(lambda key: ppo.update(ppo.init(key, box((1, 1), (2, 2))))[0])(jax.random.key(0))
    for normalisation in (lane.policy.normalisation, lane.networks.critic.reads, lane.networks.critic.says):
        assert not np.any(normalisation.mean)
        np.testing.assert_array_equal(normalisation.deviation, 1)


def test_the_kept_policy_lies_between_where_it_was_and_where_learning_is(updated: Updated) -> None:
    policies = (updated.before.policy, updated.after.policy, updated.after.networks.policy)
    start, kept, newest = (np.asarray(policy.net.output.kernel) for policy in policies)
    assert 0.05 < np.linalg.norm(kept - start) / np.linalg.norm(newest - start) < 0.5


def test_learning_rate_and_entropy_fall_linearly_over_the_run() -> None:
    config = PPOConfig(
        epochs=3, minibatches=2, learning_rate=0.4, final_learning_rate=0.1, entropy=0.1, final_entropy=0.2
    )
    np.testing.assert_allclose([config.learning_rates(10)(step) for step in (0, 30, 60, 99)], [0.4, 0.22, 0.04, 0.04])
    np.testing.assert_allclose([config.entropies(10)(update) for update in (0, 5, 10, 20)], [0.1, 0.06, 0.02, 0.02])


def test_entropy_is_rewarded_with_its_weight(updated: Updated) -> None:
    ppo, before, _, rollout = updated
    lesson, _ = ppo.lesson(before.networks.critic, rollout)
    slope = jax.jit(jax.grad(lambda n, weight: ppo.loss(n, lesson, before.batch.memories, weight)[0]))
    with_it, without = (slope(before.networks, jnp.float32(w)).policy.log_deviation for w in (0.3, 0.0))
    np.testing.assert_allclose(with_it - without, -0.3, atol=1e-4)


def test_minibatches_of_unequal_size_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"environments = 10 do not make 4 equal minibatches"):
        PPOConfig.build({"environments": 10, "minibatches": 4})
