"""Rollouts that are learnt from for other references: what the task would have given, and how much
it weighs."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.learning.ppo import PPO
from softfin.learning.rollout import AgentState, Rollout, collect_rollout
from softfin.task.references import References
from tests.learning.probes import box, learner
from tests.plants import AnalyticFin

FINS = 4
ACTIONS = 12
LOW = (1.0, -1.0)
HIGH = (3.0, 1.0)


class Relabelled(NamedTuple):
    ppo: PPO
    agent: AgentState
    rollout: Rollout
    both: Rollout
    """The rollout and its copy for other references."""


@pytest.fixture(scope="module")
def relabelled() -> Relabelled:
    ppo = learner(AnalyticFin(noise_n=0.0), 3, num_envs=FINS, episode=ACTIONS, relabelling=1.0)

    @jax.jit
    def begin(key: Any) -> Any:
        agent = ppo.init(key, box(LOW, HIGH))
        # Its output layer grows, so that the mean action depends on the reference.
        policy = jax.tree.map(lambda x: 3 * x, agent.policy.net)
        policy = type(agent.policy)(policy, agent.policy.log_std, agent.policy.normalisation, None)
        start = agent.env_state
        rollout = collect_rollout(ppo.task, policy, start, jax.random.key(1), ACTIONS // 3)[1]
        references = start.states.references
        both = ppo.relabelled(policy, rollout, start.memories, references, jax.random.key(2))
        return agent._replace(policy=policy), rollout, both

    return Relabelled(ppo, *begin(jax.random.key(0)))


def test_a_relabelled_sequence_is_what_the_same_actions_give_for_the_other_reference(
    relabelled: Relabelled,
) -> None:
    ppo, _, rollout, both = relabelled
    task = ppo.task
    reference = both.reference[0, FINS]
    assert np.all(both.reference[:, FINS] == reference)
    assert np.abs(reference - rollout.reference[0, 0]).min() > 0.01

    @jax.jit
    def act(state: Any, pre_tanh_action: Any, ticks: Any) -> Any:
        after, outcome = task.step(state, jnp.tanh(pre_tanh_action), ticks)
        privileged = task.privileged_observation(state), task.privileged_observation(after)
        return after, (task.observe(state), outcome.reward, outcome.force_error, *privileged)

    state = task.reset(jax.random.key(0), References(reference, reference))
    for t in range(ACTIONS - 1):
        state, found = act(state, rollout.pre_tanh_action[t, 0], jnp.int32((33, 33, 34)[t % 3]))
        now = jax.tree.map(lambda x, t=t: x[t, FINS], both)
        given = now.observation, now.reward, now.force_error, now.privileged_observation
        for one, other in zip((*given, now.next_privileged_observation), found, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-4)


def test_the_other_references_are_of_the_box_and_about_as_far_as_the_errors_are_large(
    relabelled: Relabelled,
) -> None:
    _, _, rollout, both = relabelled
    references = np.asarray(both.reference)
    assert np.all((references >= LOW) & (references <= HIGH))
    shift, error = (
        np.sqrt(np.mean(x**2))
        for x in (references[:, FINS:] - rollout.reference, rollout.force_error)
    )
    assert 0.05 * error < shift < 2 * error


def test_actions_weigh_as_often_as_the_policy_would_choose_them_there_at_most_once(
    relabelled: Relabelled,
) -> None:
    _, agent, rollout, both = relabelled
    policy = agent.policy
    memories = agent.env_state.memories
    replay = jax.jit(jax.vmap(policy.sequence, in_axes=(0, 1, 1), out_axes=1))
    mean = replay(memories, both.observation[:, FINS:], rollout.is_first)
    log_prob = np.asarray(policy.log_prob(mean, rollout.pre_tanh_action))
    np.testing.assert_allclose(both.log_prob[:, FINS:], log_prob, atol=1e-4)
    ratio = np.exp(log_prob - rollout.log_prob)
    np.testing.assert_allclose(both.weight[:, FINS:], np.minimum(ratio, 1), atol=1e-4)
    assert 0.05 < np.mean(ratio < 0.99) < 1


def test_the_rollout_itself_stays_and_weighs_fully(relabelled: Relabelled) -> None:
    _, _, rollout, both = relabelled
    jax.tree.map(
        lambda whole, part: np.testing.assert_array_equal(whole[:, :FINS], part), both, rollout
    )
    np.testing.assert_array_equal(rollout.weight, 1)


def test_without_relabelling_the_rollout_is_all_that_is_learnt_from(relabelled: Relabelled) -> None:
    _, agent, rollout, _ = relabelled
    plain = learner(AnalyticFin(), 3, num_envs=FINS, episode=ACTIONS, relabelling=0.0)
    memories = agent.env_state.memories
    references = agent.env_state.states.references
    assert (
        plain.relabelled(agent.policy, rollout, memories, references, jax.random.key(0)) is rollout
    )
