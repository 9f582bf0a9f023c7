"""Parity with sb3-contrib's RecurrentPPO on the same data: advantages, and the loss that its own `train` logs.

Time limits: RecurrentPPO adds discount x (value of the state that was left) to the last reward of an episode and takes
it as ended there; softfin keeps the reward and bootstraps the cut. The buffer below is filled as RecurrentPPO fills it.
"""

from types import SimpleNamespace
from typing import Any, NamedTuple

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.learning.policy import ActorCritic
from softfin.learning.ppo import PPO, Batch, advantages
from softfin.learning.rollout import Rollout, collect
from tests.learning.probes import box, learner
from tests.plants import AnalyticFin

torch = pytest.importorskip("torch", reason="needs the extra sb3")
sb3_contrib = pytest.importorskip("sb3_contrib", reason="needs the extra sb3")

TIME, FINS = 12, 4
CHANGES = {"entropy_coef": 0.02, "value_coef": 0.7, "clip_ratio": 0.15, "discount": 0.83, "gae_lambda": 0.9}


class Numbered(gymnasium.Env[Any, Any]):
    """Never played; an observation is the number of its sample, so that shuffled data can be told apart."""

    observation_space = gymnasium.spaces.Box(0, TIME * FINS, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)


class Lived(NamedTuple):
    ppo: PPO
    networks: ActorCritic
    start: Any
    rollout: Rollout
    batch: Batch


@pytest.fixture(scope="module")
def lived() -> Lived:
    """A rollout that crosses cuts."""
    ppo = learner(AnalyticFin(), 3, num_envs=FINS, episode=TIME, num_minibatches=1, num_epochs=1, **CHANGES)
    lane = jax.jit(ppo.init)(jax.random.key(0), box((1, -1), (3, 1)))
    rollout = jax.jit(lambda lane: collect(ppo.task, lane.policy, lane.env_state, jax.random.key(1), TIME // 3)[1])(
        lane
    )
    assert np.asarray(rollout.truncated)[:-1].any()
    return Lived(ppo, lane.networks, lane.env_state.memories, rollout, ppo.batch(lane.networks.critic, rollout)[0])


def peer(lived: Lived) -> Any:
    """RecurrentPPO with its buffer holding the rollout."""
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.vec_env import DummyVecEnv

    config, rollout = lived.ppo.config, lived.rollout
    model = sb3_contrib.RecurrentPPO(
        "MlpLstmPolicy", DummyVecEnv([Numbered] * FINS),
        n_steps=TIME, batch_size=TIME * FINS, n_epochs=1, learning_rate=0.0, gamma=config.discount,
        gae_lambda=config.gae_lambda, clip_range=config.clip_ratio, ent_coef=config.entropy_coef,
        vf_coef=config.value_coef,
        policy_kwargs={"lstm_hidden_size": 2}, device="cpu",
    )  # fmt: skip
    model.set_logger(configure(None, []))
    value, after = (
        np.asarray(lived.networks.critic(seen))
        for seen in (rollout.privileged_observation, rollout.next_privileged_observation)
    )
    cut = np.asarray(rollout.truncated)
    reward = np.asarray((1 - config.discount) * rollout.reward + cut * config.discount * after)
    zeros = torch.zeros(1, FINS, 2)
    memory = SimpleNamespace(pi=(zeros, zeros), vf=(zeros, zeros))
    for t in range(TIME):
        number = np.arange(FINS)[:, None] + FINS * t
        action, density = np.asarray(rollout.pre_tanh_action[t]), torch.tensor(np.asarray(rollout.log_prob[t]))
        model.rollout_buffer.add(
            number,
            action,
            reward[t],
            np.asarray(rollout.is_first[t]),
            torch.tensor(value[t]),
            density,
            lstm_states=memory,
        )
    model.rollout_buffer.compute_returns_and_advantage(torch.tensor(after[-1]), cut[-1])
    return model


def perturbed(networks: ActorCritic) -> ActorCritic:
    """Other weights, so that ratios of densities are not 1; the units of values stay."""
    other = jax.tree.map(lambda x: x + 0.1 * jnp.cos(7 * jnp.arange(x.size)).reshape(x.shape), networks)
    return eqx.tree_at(lambda n: n.critic.values, other, networks.critic.values)


def test_advantages_and_targets_are_those_of_its_buffer(lived: Lived) -> None:
    config, rollout, critic = lived.ppo.config, lived.rollout, lived.networks.critic
    reward = (1 - config.discount) * rollout.reward
    values = critic(rollout.privileged_observation), critic(rollout.next_privileged_observation)
    ours = advantages(reward, *values, rollout.truncated, config.discount, config.gae_lambda)
    buffer = peer(lived).rollout_buffer
    np.testing.assert_allclose(ours, buffer.advantages, atol=1e-5)
    np.testing.assert_allclose(lived.batch.target, buffer.returns, atol=1e-5)


def test_the_loss_is_the_one_that_its_training_step_logs(lived: Lived) -> None:
    ppo, rollout, changed, n = lived.ppo, lived.rollout, perturbed(lived.networks), TIME * FINS
    unbiased = lived.batch.advantage * ((n - 1) / n) ** 0.5  # torch divides by n - 1
    batch = lived.batch._replace(advantage=unbiased)
    loss, metrics = ppo.loss(changed, batch, lived.start, jnp.float32(ppo.config.entropy_coef))

    mean = jax.vmap(changed.policy.sequence, (0, 1, 1), 1)(lived.start, rollout.observation, rollout.is_first)
    density = torch.tensor(np.asarray(changed.policy.log_prob(mean, rollout.pre_tanh_action)).reshape(-1))
    value = torch.tensor(np.asarray(changed.critic(rollout.privileged_observation)).reshape(-1))
    entropy = torch.full((n,), float(changed.policy.action_entropy()))
    model = peer(lived)
    nothing = 0 * sum(parameter.sum() for parameter in model.policy.parameters())  # for its backward pass

    def evaluated(observations: Any, *_: Any) -> Any:
        sample = observations.flatten().long()
        return value[sample] + nothing, density[sample] + nothing, entropy[sample]

    model.policy.evaluate_actions = evaluated
    model.train()
    logged = model.logger.name_to_value
    assert 0.1 < logged["train/clip_fraction"] < 0.9
    np.testing.assert_allclose(metrics["clipped"], logged["train/clip_fraction"], atol=1e-6)
    np.testing.assert_allclose(metrics["kl"], logged["train/approx_kl"], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(metrics["value_loss"], logged["train/value_loss"], rtol=1e-4)
    np.testing.assert_allclose(loss, logged["train/loss"], rtol=1e-4)
