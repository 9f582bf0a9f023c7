"""The task on an analytic fin."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError
from softfin.core.plant import roll
from softfin.core.quantities import PAPER_LIMITS, Command, Reading, action_to_command
from softfin.gaits.reachable import Cell
from softfin.task.references import References
from softfin.task.task import (
    ForceTracking,
    Outcome,
    RewardConfig,
    TaskConfig,
    TaskState,
    command_to_action,
)
from tests.plants import AnalyticFin, PlainFin

BOX = References.of(Cell(low=(1, -1), high=(3, 1)))
STROKE = jnp.array([0.5, 0.9])


def played(task: ForceTracking, actions: Any, seed: int = 0) -> tuple[TaskState, list[Outcome]]:
    step = jax.jit(task.step)
    state = task.reset(jax.random.key(seed), BOX)
    outcomes = []
    for i, action in enumerate(actions):
        ticks = PAPER_CLOCK.ticks[i % 3]
        state, outcome = step(state, jnp.asarray(action, jnp.float32), ticks)
        outcomes.append(outcome._replace(forces=outcome.forces[:ticks]))
    return state, outcomes


def swings(count: int) -> list[tuple[float, float]]:
    return [(0.6 * (-1) ** i, 0.8) for i in range(count)]


class Echo:
    """A plant whose force tells the tick and whose angle tells the command."""

    limits = PAPER_LIMITS

    def init(self, key: Any) -> Any:
        return jnp.int32(0)

    def advance(self, state: Any, command: Command, ticks: int) -> tuple[Any, Reading]:
        count = state + 1 + jnp.arange(ticks)
        force = jnp.stack([count, -2 * count], axis=1).astype(jnp.float32)
        angle = jnp.full(ticks, command.angle)
        return state + ticks, Reading(count / 100, angle, jnp.zeros(ticks), force)


def test_the_observation_is_angle_reference_and_the_last_four_actions_newest_first() -> None:
    task = ForceTracking(Echo(), TaskConfig())
    actions = [(0.1, -0.1), (0.2, -0.2), (0.3, -0.3), (0.4, -0.4), (0.5, -0.5)]
    state, _ = played(task, actions)

    observation = task.observe(state)

    assert observation.shape == (11,)
    expected = [0.5, *(np.asarray(state.reference) / 3), *np.ravel(actions[:0:-1])]
    np.testing.assert_allclose(observation, expected, atol=1e-6)


def test_k_past_actions_make_5_plus_2_k_observations() -> None:
    for k in (0, 3, 5):
        task = ForceTracking(Echo(), TaskConfig(past_actions=k))
        assert (
            task.observe(task.reset(jax.random.key(0), BOX)).shape
            == (5 + 2 * k,)
            == (task.config.observations,)
        )


def test_before_the_first_action_the_memory_is_that_of_a_fin_told_to_stay() -> None:
    task = ForceTracking(AnalyticFin(), TaskConfig())
    observation = task.observe(task.reset(jax.random.key(0), BOX))
    np.testing.assert_allclose(observation[3:], np.tile([0, -1], 4), atol=1e-6)


def test_the_reward_is_that_of_the_samples_since_the_reset() -> None:
    config = TaskConfig(reward=RewardConfig(weight=(1, 2), smoothness=(0.1, 0.2), sobolev="mean"))
    task = ForceTracking(AnalyticFin(), config)
    state, outcomes = played(task, swings(8))
    forces = np.concatenate([outcome.forces for outcome in outcomes])
    for count, outcome in zip(np.cumsum([33, 33, 34, 33, 33, 34, 33, 33]), outcomes, strict=True):
        window = forces[max(0, count - 200) : count]
        error = np.abs(window.mean(axis=0) - np.asarray(state.reference))
        rough = np.sqrt((np.diff(window, axis=0) ** 2).mean(axis=0))
        assert float(outcome.reward) == pytest.approx(
            -(error[0] + 0.1 * rough[0] + 2 * (error[1] + 0.2 * rough[1])), abs=1e-4
        )


def test_the_paper_sum_form_is_the_default_and_the_mean_form_has_a_name() -> None:
    by_name = {
        name: played(
            ForceTracking(AnalyticFin(), TaskConfig(reward=RewardConfig(sobolev=name))), swings(6)
        )[1][-1]
        for name in ("sum", "mean")
    }
    default = played(ForceTracking(AnalyticFin(), TaskConfig()), swings(6))[1][-1]
    np.testing.assert_array_equal(default.terms.smoothness, by_name["sum"].terms.smoothness)
    np.testing.assert_allclose(
        by_name["sum"].terms.smoothness, np.sqrt(199) * by_name["mean"].terms.smoothness, rtol=1e-5
    )


def test_the_window_is_cleared_on_reset() -> None:
    task = ForceTracking(AnalyticFin(), TaskConfig())
    state, _ = played(task, swings(9))
    assert int(state.samples) == 200
    again = task.reset(state.key, state.references)
    assert int(again.samples) == 0
    assert int(again.age) == 0
    assert not np.any(again.forces)


@pytest.mark.parametrize("actions", [1, 3], ids=["33 ticks", "34 ticks"])
def test_the_angle_is_that_of_the_last_tick_that_an_action_is_held(actions: int) -> None:
    task = ForceTracking(AnalyticFin(), TaskConfig())
    fin = AnalyticFin()
    # Slow enough to be on its way when the action ends.
    slow = [(0.9, -1.0)] * actions
    state, _ = played(task, slow)
    commands = jax.tree.map(
        lambda x: jnp.full(sum(PAPER_CLOCK.ticks[:actions]), x),
        action_to_command(fin.limits, jnp.array(slow[0])),
    )
    _, reading = roll(fin, fin.init(jax.random.key(0)), commands)
    assert float(state.angle) == pytest.approx(float(reading.angle[-1]), abs=1e-6)
    assert abs(float(reading.angle[-1] - reading.angle[-2])) > 1e-3


def test_six_actions_are_exactly_the_window() -> None:
    task = ForceTracking(Echo(), TaskConfig())
    state, outcomes = played(task, swings(7))
    assert [len(outcome.forces) for outcome in outcomes] == [33, 33, 34, 33, 33, 34, 33]
    np.testing.assert_array_equal(state.forces[:, 0], np.arange(34, 234))


def test_normalised_actions_span_the_limits_of_the_plant() -> None:
    low = action_to_command(PAPER_LIMITS, -jnp.ones(2))
    high = action_to_command(PAPER_LIMITS, jnp.ones(2))
    np.testing.assert_allclose([*low, *high], [-np.pi / 2, 1, np.pi / 2, np.pi], rtol=1e-6)
    np.testing.assert_allclose(
        command_to_action(PAPER_LIMITS, action_to_command(PAPER_LIMITS, STROKE)), STROKE, atol=1e-6
    )


def test_a_batch_does_what_each_fin_does_alone() -> None:
    task = ForceTracking(PlainFin(), TaskConfig())
    keys = jax.random.split(jax.random.key(3), 4)
    actions = jax.random.uniform(jax.random.key(1), (4, 2), minval=-1.0)
    step = jax.jit(partial(task.step, ticks=33))
    _, outcomes = jax.vmap(step)(jax.vmap(task.reset, (0, None))(keys, BOX), actions)
    for i in range(4):
        _, alone = step(task.reset(keys[i], BOX), actions[i])
        np.testing.assert_allclose(outcomes.reward[i], alone.reward, rtol=1e-5)
        np.testing.assert_allclose(outcomes.forces[i], alone.forces, atol=1e-5)


def test_references_are_redrawn_when_they_are_due() -> None:
    task = ForceTracking(Echo(), TaskConfig(reference_actions=4))
    step = jax.jit(task.step)
    state = task.reset(jax.random.key(0), BOX)
    references = [tuple(np.asarray(state.reference))]
    for i in range(8):
        state, _ = step(state, STROKE, PAPER_CLOCK.ticks[i % 3])
        references.append(tuple(np.asarray(state.reference)))
    assert [a != b for a, b in zip(references[1:], references, strict=False)] == [False] * 3 + [
        True
    ] + [False] * 3 + [True]


def test_no_episode_draws_what_the_one_before_drew() -> None:
    """Each goes on with the key of the last; the references of all its actions differ from
    theirs."""
    task = ForceTracking(Echo(), TaskConfig(reference_actions=1))
    step = jax.jit(task.step)
    state = task.reset(jax.random.key(0), BOX)
    drawn = []
    for _ in range(3):
        drawn.append(np.asarray(state.reference))
        for ticks in PAPER_CLOCK.ticks:
            state, _ = step(state, STROKE, ticks)
            drawn.append(np.asarray(state.reference))
        state = task.reset(state.key, BOX)
    numbers = np.concatenate([np.ravel(each) for each in drawn])
    assert len(np.unique(numbers)) == len(numbers) == 3 * 2 * (1 + 3)


def test_every_key_is_used_once() -> None:
    """As a random key that is given away and used again gives the same numbers twice."""
    task = ForceTracking(Echo(), TaskConfig())

    def episode(key: Any) -> Any:
        state, _ = task.step(task.reset(key, BOX), STROKE, 33)
        return task.step(task.reset(state.key, BOX), STROKE, 33)[0].key

    with jax.debug_key_reuse(True):
        jax.jit(episode)(jax.random.key(0))


def test_an_episode_is_over_after_its_actions() -> None:
    task = ForceTracking(Echo(), TaskConfig(episode_actions=6))
    assert not task.truncated(played(task, swings(5))[0])
    assert task.truncated(played(task, swings(6))[0])


def test_the_critic_also_sees_the_mean_force_of_each_part_of_the_window() -> None:
    task = ForceTracking(Echo(), TaskConfig())
    state, _ = played(task, swings(6))
    privileged = np.asarray(task.privileged_observation(state))
    np.testing.assert_array_equal(privileged[:11], task.observe(state))
    parts = np.arange(1, 201).reshape(8, 25).mean(axis=1)
    np.testing.assert_allclose(
        privileged[11:27].reshape(8, 2), np.stack([parts, -2 * parts], 1) / 3, rtol=1e-5
    )
    np.testing.assert_array_equal(privileged[27:], [1, 1, 0, 0])


def test_an_episode_shorter_than_the_window_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"episode_actions = 3: .* use at least 6"):
        TaskConfig.build({"episode_actions": 3})


def test_observations_and_rewards_have_the_same_magnitude_for_a_fin_of_another_size() -> None:
    usual = TaskConfig(reward=RewardConfig(weight=(1, 2)))
    large = usual.scaled(5.0)
    assert large.force_scale_n == 5 * usual.force_scale_n
    assert large.reward.weight == pytest.approx((0.2, 0.4))
    assert large.reward.smoothness == usual.reward.smoothness
