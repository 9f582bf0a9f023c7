"""A policy is taught a table of gaits."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.plant import counted
from softfin.gaits.reachable import Cell
from softfin.learning.gradient import CloningConfig, Demonstrations, clone_gaits, record_demonstrations
from softfin.learning.policy import Policy, PolicyConfig
from softfin.task.references import References
from softfin.task.task import ForceTracking, TaskConfig
from tests.learning.mapped import WITHIN, mapped
from tests.plants import StrokeFin

TASK = ForceTracking(StrokeFin(), TaskConfig(phase=True))
CONFIG = CloningConfig(num_envs=24, num_steps=24, num_updates=250, batch_size=12, learning_rate=1e-2)
assert WITHIN.box is not None
REFERENCES = References.of(WITHIN.box)
KEY = jax.random.key(3)
POLICY = jax.jit(lambda key: Policy.create(key, PolicyConfig(units=16, width=16), TASK.config.observations))(
    jax.random.key(0)
)


@cache
def shown() -> Demonstrations:
    table = mapped().gaits.table
    return jax.jit(lambda key: record_demonstrations(TASK, table, REFERENCES, key, CONFIG))(jax.random.key(9))


@cache
def taught() -> Policy:
    table = mapped().gaits.table
    return jax.jit(lambda key: clone_gaits(TASK, POLICY, table, REFERENCES, key, CONFIG))(KEY)


@jax.jit
def said(policy: Policy, observation: Any) -> Any:
    """Actions along the time of each fin."""

    def along(x: Any) -> Any:
        return jax.lax.scan(lambda *now: policy.act(*now), policy.init(), x)[1]

    return jax.vmap(along, 1, 1)(observation)


def unlike(policy: Policy) -> float:
    """Root of the mean square over fins that it was not taught with."""
    observation, action = (np.asarray(part)[:, :8] for part in shown())
    return float(np.sqrt(np.mean((np.asarray(said(policy, observation)) - action) ** 2)))


def test_what_is_shown_is_the_gait_of_the_observed_reference_in_its_phase() -> None:
    observation, action = (np.asarray(part) for part in shown())
    table, times = mapped().gaits.table, [0, 5, 13, 23]
    assert observation.shape == (24, 24, 13)
    gaits = jax.jit(jax.vmap(table.gait))(observation[times, 4, 1:3] * TASK.config.force_scale_n)
    for time, gait in zip(times, gaits, strict=True):
        np.testing.assert_allclose(action[time, 4], gait[time % CYCLE_ACTIONS], atol=1e-4)


def test_what_is_observed_is_what_the_actions_before_led_to() -> None:
    observation, action = (np.asarray(part) for part in shown())
    np.testing.assert_allclose(observation[1:, :, 3:5], action[:-1], atol=1e-6)
    np.testing.assert_allclose(observation[1:, :, 0], action[:-1, :, 0], atol=1e-5)


def test_each_fin_is_shown_two_references_and_the_box_is_filled_with_them() -> None:
    references = np.asarray(shown().observation)[..., 1:3] * TASK.config.force_scale_n
    np.testing.assert_array_equal(references[:12], np.broadcast_to(references[0], (12, 24, 2)))
    np.testing.assert_array_equal(references[12:], np.broadcast_to(references[12], (12, 24, 2)))
    assert (np.abs(references[0] - references[12]).max(axis=1) > 1e-3).all()
    assert np.ptp(references, axis=(0, 1)).min() > 0.7


def test_the_taught_policy_acts_as_the_table() -> None:
    assert unlike(POLICY) > 0.4
    assert unlike(taught()) < 0.12


def test_the_taught_policy_holds_forces_by_itself() -> None:
    """In the loop with its own actions, where nobody leads it back."""
    cell = Cell(low=(1, 0.25), high=(1, 0.25))

    def drive(policy: Policy) -> Any:
        def act(carry: Any, ticks: Any) -> Any:
            state, memory = carry
            memory, action = policy.act(memory, TASK.observe(state))
            state, outcome = TASK.step(state, action, ticks)
            return (state, memory), outcome.forces

        start = TASK.reset(KEY, References.of(cell)), policy.init()
        return counted(jax.lax.scan(act, start, jnp.asarray(ticks_of(18)))[1], 18)[-200:].mean(axis=0)

    run = jax.jit(drive)
    np.testing.assert_allclose(run(taught()), (1, 0.25), atol=0.2)
    assert np.abs(run(POLICY) - np.array([1, 0.25])).max() > 0.5
