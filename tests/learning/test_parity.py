"""Parity with sb3-contrib's RecurrentPPO on the same data: advantages, and the loss that its own
`train` logs.

recurrent_ppo.json has the data and what RecurrentPPO made of it; recurrent_ppo.py next to it wrote
them.
"""

import json
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.learning.policy import ActorCritic, Critic, Policy, PolicyConfig
from softfin.learning.ppo import PPO, Batch, advantages
from softfin.learning.rollout import Rollout
from tests.learning.probes import learner
from tests.learning.recurrent_ppo import FILE
from tests.plants import AnalyticFin


class GivenPolicy(Policy):
    """A policy whose mean action is its observation."""

    def sequence(self, memory: Any, observation: Any, is_first: Any) -> Any:
        return observation


class GivenCritic(Critic):
    """A critic whose value is its observation."""

    def _normalised(self, privileged: Any) -> Any:
        return privileged[..., 0]


class Case(NamedTuple):
    ppo: PPO
    inputs: dict[str, Any]
    outputs: dict[str, Any]
    before: ActorCritic
    """The networks that acted."""
    changed: ActorCritic
    """The networks that learn."""
    rollout: Rollout
    batch: Batch


def networks(log_std: Any) -> ActorCritic:
    policy = GivenPolicy.create(jax.random.key(0), PolicyConfig(units=2, width=2), observations=2)
    return ActorCritic(
        eqx.tree_at(lambda policy: policy.log_std, policy, log_std),
        GivenCritic.create(jax.random.key(0), 1, 2),
    )


@pytest.fixture(scope="module")
def case() -> Case:
    reference = json.loads(FILE.read_text())
    inputs = {
        name: jnp.asarray(value, bool if name in ("is_first", "truncated") else jnp.float32)
        for name, value in reference["inputs"].items()
    }
    time, num_envs = inputs["reward"].shape
    ppo = learner(
        AnalyticFin(),
        3,
        num_envs=num_envs,
        episode=time,
        num_minibatches=1,
        num_epochs=1,
        **reference["settings"],
    )
    before = networks(inputs["log_std"])
    rollout = Rollout(
        observation=inputs["mean"],
        pre_tanh_action=inputs["action"],
        log_prob=before.policy.log_prob(inputs["mean"], inputs["action"]),
        reward=inputs["reward"],
        force_error=jnp.zeros((time, num_envs, 2)),
        privileged_observation=inputs["value"][..., None],
        next_privileged_observation=inputs["next_value"][..., None],
        is_first=inputs["is_first"],
        truncated=inputs["truncated"],
    )
    batch, _ = ppo.batch(before.critic, rollout)
    return Case(
        ppo,
        inputs,
        reference["outputs"],
        before,
        networks(inputs["changed_log_std"]),
        rollout,
        batch,
    )


def test_the_rollout_has_truncations_within_it_and_at_its_end(case: Case) -> None:
    truncated = np.asarray(case.inputs["truncated"])
    assert truncated[:-1].any()
    assert truncated[-1].any()
    assert not truncated[-1].all()


def test_advantages_and_targets_are_those_of_its_buffer(case: Case) -> None:
    config = case.ppo.config
    inputs = case.inputs
    reward = (1 - config.discount) * inputs["reward"]
    ours = advantages(
        reward,
        inputs["value"],
        inputs["next_value"],
        inputs["truncated"],
        config.discount,
        config.gae_lambda,
    )
    np.testing.assert_allclose(ours, case.outputs["advantages"], atol=1e-5)
    np.testing.assert_allclose(case.batch.target, case.outputs["returns"], atol=1e-5)


def test_the_loss_is_the_one_that_its_training_step_logs(case: Case) -> None:
    inputs = case.inputs
    logged = case.outputs
    num_samples = inputs["reward"].size
    # torch's standard deviation divides by n - 1.
    unbiased = case.batch.advantage * ((num_samples - 1) / num_samples) ** 0.5
    rollout = case.rollout._replace(
        observation=inputs["changed_mean"],
        privileged_observation=inputs["changed_value"][..., None],
    )
    batch = case.batch._replace(rollout=rollout, advantage=unbiased)
    memories = jax.tree.map(
        lambda leaf: jnp.tile(leaf, (inputs["reward"].shape[1], 1)), case.changed.policy.init()
    )
    loss, metrics = case.ppo.loss(
        case.changed, batch, memories, jnp.float32(case.ppo.config.entropy_coef)
    )
    assert 0.1 < logged["clipped"] < 0.9
    np.testing.assert_allclose(metrics["clipped"], logged["clipped"], atol=1e-6)
    np.testing.assert_allclose(metrics["kl"], logged["kl"], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(metrics["value_loss"], logged["value_loss"], rtol=1e-4)
    np.testing.assert_allclose(loss, logged["loss"], rtol=1e-4)
