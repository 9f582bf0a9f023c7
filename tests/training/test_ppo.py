"""PPO learns what each probe asks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.errors import ConfigurationError
from softfin.training.lstm import Memory
from softfin.training.policy import Policy
from softfin.training.ppo import PPO, Lane, PPOConfig
from softfin.training.score import score
from tests.training.probes import Direct, Recall, box, learner


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
    ppo = learner(Direct(), updates=60, episode=6, learning_rate=1e-2, rollout_actions=6)
    references = [(-2.0, 1.5), (2.0, 2.5), (0.0, 2.0)]
    lane = trained(ppo, box((-3, 1.5), (3, 2.5)))
    assert errors(ppo, lane.networks.policy, references).mean() < 0.15
    assert errors(ppo, ppo.init(jax.random.key(0), box((-3, 1.5), (3, 2.5))).networks.policy, references).mean() > 0.5


@pytest.mark.slow
def test_a_task_that_needs_memory_is_learnt_and_not_without_it() -> None:
    ppo = learner(Recall(), updates=150, learning_rate=1e-2, environments=32)
    policy = trained(ppo, box((2, 0), (2, 0))).networks.policy
    assert errors(ppo, policy, [(2, 0)])[:, 0].mean() < 0.4
    assert errors(ppo, forgetful(policy), [(2, 0)])[:, 0].mean() > 0.9


def forgetful(policy: Policy) -> Policy:
    class Forgetful(Policy):
        def act(self, memory: Memory, observation: Any) -> Any:
            return Policy.act(self, self.init(), observation)

    return Forgetful(policy.net, policy.log_deviation)


def test_minibatches_of_unequal_size_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"environments = 10 do not make 4 equal minibatches"):
        PPOConfig.build({"environments": 10, "minibatches": 4})
