"""PPO learns what each probe asks."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.policy import PolicyMemory
from softfin.core.errors import ConfigurationError
from softfin.learning.layers import cleared
from softfin.learning.policy import ActorCritic, Policy
from softfin.learning.ppo import PPO, PPOConfig
from softfin.learning.rollout import AgentState, EnvState, Rollout, collect_rollout, evaluate_policy
from softfin.task.references import References
from tests.learning.probes import (
    PROBES,
    AnyProbe,
    Delayed,
    Direct,
    Late,
    Probe,
    Recall,
    Still,
    box,
    learner,
)


class Playing(Policy):
    """It may be blind to its past actions, into which a policy without memory writes notes to
    itself.

    And its memory may be cleared at every step. Both are values, so that one program holds them
    all.
    """

    blind: Any
    forgets: Any

    def step(self, memory: PolicyMemory, observation: Any) -> Any:
        return Policy.step(self, cleared(memory, self.forgets > 0), self._seen(observation))

    def sequence(self, memory: PolicyMemory, observation: Any, is_first: Any) -> Any:
        return Policy.sequence(self, memory, self._seen(observation), is_first | (self.forgets > 0))

    def _seen(self, observation: Any) -> Any:
        return jnp.where(self.blind > 0, observation.at[..., 3:].set(0), observation)


class Case(NamedTuple):
    """What a lane learns."""

    probe: int
    references: References
    at: Any
    """References that it is scored at."""
    learning_rate: float = 1e-2
    blind: float = 0.0
    forgets: float = 0.0


def one(probe: type[Probe], reference: tuple[float, float], *rest: float) -> Case:
    """Of a single reference."""
    return Case(PROBES.index(probe), box(reference, reference), np.float32([reference]), *rest)


CASES = {
    "direct": Case(
        PROBES.index(Direct),
        box((-3, 1.5), (3, 2.5)),
        np.float32([(-2, 1.5), (2, 2.5), (0, 2)]),
        3e-3,
    ),
    "delayed": one(Delayed, (2, 2)),
    "still": one(Still, (4, -3)),
    "late": one(Late, (1, 0)),
    "recall": one(Recall, (2, 0), 5e-3, 1.0),
    "forgetful": one(Recall, (2, 0), 5e-3, 1.0, 1.0),
}
LANES: Case = jax.tree.map(
    lambda *leaves: np.stack([np.asarray(jnp.asarray(leaf)) for leaf in leaves]),
    *(case._replace(at=np.broadcast_to(case.at, (3, 2))) for case in CASES.values()),
)
ACTIONS = 12


class CasePPO(PPO):
    """Of one case, whose numbers may be values in a program."""

    @classmethod
    def of(cls, case: Case) -> "CasePPO":
        plain = learner(
            AnyProbe(case.probe), updates=60, episode=ACTIONS, discount=0.5, averaging=3.0
        )
        config = plain.config.model_copy(update={"learning_rate": case.learning_rate})
        return cls(plain.task, config, plain.policy, plain.num_updates)

    def begun(self, case: Case, key: Any) -> AgentState:
        lane = PPO.init(self, key, case.references)
        policy = Playing(
            lane.policy.net,
            lane.policy.log_std,
            lane.policy.normalisation,
            case.blind,
            case.forgets,
        )
        networks = ActorCritic(policy, lane.networks.critic)
        return lane._replace(
            networks=networks, policy=policy, optimiser=self._optimiser().init(networks)
        )


begin = jax.jit(jax.vmap(lambda case, key: CasePPO.of(case).begun(case, key)))
update = jax.jit(jax.vmap(lambda case, lane: CasePPO.of(case).update(lane)[0]))


@jax.jit
@jax.vmap
def played(case: Case, lane: AgentState, environments: EnvState, key: Any) -> tuple[Rollout, Any]:
    """A rollout, and what the critic says along it."""
    rollout = collect_rollout(
        CasePPO.of(case).task, lane.networks.policy, environments, key, ACTIONS // 3
    )[1]
    return rollout, lane.networks.critic(rollout.privileged_observation)


@jax.jit
@jax.vmap
def from_rest(case: Case, now: EnvState) -> EnvState:
    again = jax.vmap(CasePPO.of(case).task.reset)(now.states.key, now.states.references)
    return now._replace(states=again, is_first=jnp.ones_like(now.is_first))


@jax.jit
@jax.vmap
def errors(case: Case, policy: Policy) -> Any:
    """Deterministic, for each reference 16 fins with keys of their own."""
    return evaluate_policy(
        CasePPO.of(case).task, policy, jnp.repeat(case.at, 16, axis=0), jax.random.key(7)
    ).error


def of(name: str, values: Any) -> Any:
    """A case's part."""
    return jax.tree.map(lambda x: x[list(CASES).index(name)], values)


class Learnt(NamedTuple):
    """All cases, lanes of one run."""

    before: AgentState
    after: AgentState
    """After the first update."""
    end: AgentState
    rollout: Rollout
    """That the first update learnt from."""


@pytest.fixture(scope="module")
def learnt() -> Learnt:
    count = len(CASES)
    before = begin(LANES, jax.random.split(jax.random.key(0), count))
    play = jax.vmap(lambda key: jax.random.split(key, 3)[0])(before.key)
    after = end = update(LANES, before)
    for _ in range(59):
        end = update(LANES, end)
    return Learnt(before, after, end, played(LANES, before, before.env_state, play)[0])


@pytest.fixture(scope="module")
def scored(learnt: Learnt) -> Any:
    return np.asarray(errors(LANES, learnt.end.networks.policy))


@pytest.fixture(scope="module")
def values(learnt: Learnt) -> np.ndarray:
    """What the critic says along an episode, mean over the fins."""
    batch = from_rest(LANES, learnt.end.env_state)
    return np.asarray(played(LANES, learnt.end, batch, learnt.end.key)[1].mean(axis=2))


def test_the_action_that_makes_the_reference_is_learnt_for_every_reference(
    learnt: Learnt, scored: Any
) -> None:
    assert of("direct", scored).mean() < 0.15
    assert of("direct", np.asarray(errors(LANES, learnt.before.networks.policy))).mean() > 0.5


def test_an_action_whose_effect_comes_one_action_later_is_learnt(scored: Any) -> None:
    assert of("delayed", scored).mean() < 0.5


def test_the_value_of_a_constant_reward_is_that_reward(values: np.ndarray) -> None:
    np.testing.assert_allclose(of("still", values)[1:6], -7, atol=0.3)


def test_values_ahead_of_a_change_are_discounted(values: np.ndarray) -> None:
    np.testing.assert_allclose(
        of("late", values)[:6], [-(1 - 0.5**3), -(1 - 0.5**2), -0.5, 0, 0, 0], atol=0.05
    )


def test_a_task_that_needs_memory_is_learnt_with_it(learnt: Learnt, scored: Any) -> None:
    assert of("recall", scored)[:, 0].mean() < 0.5
    policy = learnt.end.networks.policy
    forgetful = eqx.tree_at(lambda policy: policy.forgets, policy, jnp.ones_like(policy.forgets))
    assert of("recall", np.asarray(errors(LANES, forgetful)))[:, 0].mean() > 1.5


def test_a_task_that_needs_memory_is_not_learnt_without_it(scored: Any) -> None:
    assert of("forgetful", scored)[:, 0].mean() > 1.5


def test_the_policy_reads_in_units_of_what_its_fins_observed(learnt: Learnt) -> None:
    seen = np.asarray(of("direct", learnt.rollout.observation))
    seen = seen.reshape(-1, seen.shape[-1])
    for policy in (learnt.after.networks.policy, learnt.after.policy):
        normalisation = of("direct", policy.normalisation)
        np.testing.assert_allclose(normalisation.mean, seen.mean(axis=0), atol=1e-3)
        np.testing.assert_allclose(normalisation.std, seen.std(axis=0), atol=1e-3)
        assert float(normalisation.count) == len(seen)


def test_the_kept_policy_lies_between_where_it_was_and_where_learning_is(learnt: Learnt) -> None:
    policies = (learnt.before.policy, learnt.after.policy, learnt.after.networks.policy)
    start, kept, newest = (
        np.asarray(of("direct", policy.net.output.kernel)) for policy in policies
    )
    assert 0.05 < np.linalg.norm(kept - start) / np.linalg.norm(newest - start) < 0.5


def test_without_averaging_the_newest_policy_is_kept() -> None:
    ppo = learner(Direct(), updates=2, averaging=0.0, num_epochs=1)
    start = ppo.init(jax.random.key(0), box((1, 1.5), (2, 2.5)))
    after = jax.jit(ppo.update)(start)[0]
    kept = after.policy
    newest = after.networks.policy
    assert not np.array_equal(kept.net.output.kernel, start.policy.net.output.kernel)
    jax.tree.map(np.testing.assert_array_equal, kept, newest)


def test_learning_rate_and_entropy_fall_linearly_over_the_run() -> None:
    config = PPOConfig(
        num_epochs=3,
        num_minibatches=2,
        learning_rate=0.4,
        final_learning_rate=0.1,
        entropy_coef=0.1,
    )
    np.testing.assert_allclose(
        [config.learning_rates(10)(step) for step in (0, 30, 60, 99)], [0.4, 0.22, 0.04, 0.04]
    )
    np.testing.assert_allclose(
        [config.entropy_coefs(10)(update) for update in (0, 5, 10, 20)], [0.1, 0.05, 0.0, 0.0]
    )


def test_entropy_is_rewarded_with_its_weight(learnt: Learnt) -> None:
    @jax.jit
    def slope(lane: AgentState, rollout: Rollout, weight: Any) -> Any:
        ppo = CasePPO.of(CASES["direct"])
        batch, _ = ppo.batch(lane.networks.critic, rollout)
        found = jax.grad(lambda n: ppo.loss(n, batch, lane.env_state.memories, weight)[0])(
            lane.networks
        )
        return found.policy.log_std

    before = of("direct", learnt.before)
    rollout = of("direct", learnt.rollout)
    with_it, without = (np.asarray(slope(before, rollout, jnp.float32(w))) for w in (0.3, 0.0))
    np.testing.assert_allclose(with_it - without, -0.3, atol=1e-4)


def test_minibatches_of_unequal_size_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"num_envs = 10 .*num_minibatches = 4"):
        PPOConfig.build({"num_envs": 10, "num_minibatches": 4})
