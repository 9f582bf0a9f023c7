"""Rollouts: what the learner replays is what was lived through; resets; the clock."""

from typing import Any

import jax
import numpy as np
import pytest

from softfin.control.policy import PolicyMemory
from softfin.learning.policy import ActorCritic, Policy
from softfin.learning.ppo import PPO
from softfin.learning.rollout import AgentState, Rollout, collect_rollout
from tests.learning.probes import box, learner
from tests.plants import AnalyticFin

BOX = box((1, -1), (3, 1))
Lived = tuple[PPO, AgentState, AgentState, Rollout]


@pytest.fixture(scope="module")
def lived() -> Lived:
    """A learner whose second rollout crosses resets."""
    ppo = learner(AnalyticFin(), 3, num_envs=4, episode=12)
    start = jax.jit(ppo.init)(jax.random.key(0), BOX)
    play = jax.jit(
        lambda lane, key: collect_rollout(ppo.task, lane.networks.policy, lane.env_state, key, 4)
    )
    env_state, first = play(start, jax.random.key(1))
    policy = jax.jit(Policy.update_statistics)(start.networks.policy, first.observation)
    before = start._replace(
        env_state=env_state, networks=ActorCritic(policy, start.networks.critic)
    )
    env_state, rollout = play(before, jax.random.key(2))
    return ppo, before, before._replace(env_state=env_state), jax.tree.map(np.asarray, rollout)


def test_the_replay_of_a_rollout_gives_the_densities_it_was_lived_with(lived: Lived) -> None:
    _, before, _, rollout = lived
    assert rollout.is_first.any()
    policy = before.networks.policy

    @jax.jit
    def replayed(policy: Policy, memories: PolicyMemory, rollout: Rollout) -> Any:
        mean = jax.vmap(policy.sequence, (0, 1, 1), 1)(
            memories, rollout.observation, rollout.is_first
        )
        return policy.log_prob(mean, rollout.pre_tanh_action)

    density = replayed(policy, before.env_state.memories, rollout)
    np.testing.assert_allclose(density, rollout.log_prob, atol=1e-4)


def test_episodes_are_cut_once_each_at_spread_times_and_only_at_the_end_of_a_cycle(
    lived: Lived,
) -> None:
    cut = np.asarray(lived[-1].truncated)
    assert cut.sum(axis=0).tolist() == [1, 1, 1, 1]
    assert sorted(np.argmax(cut, axis=0)) == [2, 5, 8, 11]


def test_a_reset_comes_right_after_a_cut_and_shows_a_fin_at_rest(lived: Lived) -> None:
    rollout = lived[-1]
    after = lived[2]
    np.testing.assert_array_equal(rollout.is_first[1:], rollout.truncated[:-1])
    np.testing.assert_array_equal(after.env_state.is_first, rollout.truncated[-1])
    at_rest = rollout.observation[rollout.is_first]
    np.testing.assert_allclose(at_rest[:, 0], 0)
    np.testing.assert_allclose(at_rest[:, 3:], np.tile([0.0, -1.0], (len(at_rest), 1)), atol=1e-6)


def test_a_reset_clears_what_the_networks_remember(lived: Lived) -> None:
    _, before, _, rollout = lived
    policy = before.networks.policy
    time, env = np.argwhere(np.asarray(rollout.is_first))[0]

    @jax.jit
    def at_rest(policy: Policy, observation: Any, raw: Any) -> Any:
        return policy.log_prob(policy.step(policy.init(), observation)[1], raw)

    density = at_rest(policy, rollout.observation[time, env], rollout.pre_tanh_action[time, env])
    np.testing.assert_allclose(density, rollout.log_prob[time, env], atol=1e-4)


def test_the_critic_sees_the_state_that_was_left_not_the_one_after_the_reset(lived: Lived) -> None:
    rollout = lived[-1]
    goes_on = ~np.asarray(rollout.truncated)[:-1]
    np.testing.assert_array_equal(
        rollout.next_privileged_observation[:-1][goes_on],
        rollout.privileged_observation[1:][goes_on],
    )
    part_of_window_that_counts = -4
    left = np.asarray(rollout.next_privileged_observation)[np.asarray(rollout.truncated)]
    assert np.all(left[:, part_of_window_that_counts] == 1)
    assert np.all(
        np.asarray(rollout.privileged_observation)[np.asarray(rollout.is_first)][
            :, part_of_window_that_counts
        ]
        == 0
    )


def test_all_environments_keep_to_the_33_33_34_clock(lived: Lived) -> None:
    ages = lived[2].env_state.states.age
    ticks = lived[2].env_state.states.plant.ticks
    assert np.all(np.asarray(ages) % 3 == 0)
    assert np.all(np.asarray(ticks) % 100 == 0)


def test_every_environment_has_its_own_reference(lived: Lived) -> None:
    references = np.asarray(lived[2].env_state.states.reference)
    assert len(np.unique(references, axis=0)) == 4
    assert np.all((references >= [1, -1]) & (references <= [3, 1]))
