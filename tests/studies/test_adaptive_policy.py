import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.adaptive_policy import (
    ERROR_SCALE_RAD,
    TORQUE_SCALE_NM,
    VARIANTS,
    AdaptivePolicy,
    AdaptiveTaskConfig,
    AdaptiveTracking,
    errors,
    held_out_keys,
)

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.plant import drop_padding
from softfin.core.quantities import action_to_command
from softfin.learning.policy import Policy, PolicyConfig
from softfin.task.references import References

CONFIG = AdaptiveTaskConfig()
OWN = CONFIG.observations - len(VARIANTS["adaptive"])
"""Size of an observation without the senses."""

REFERENCE = jnp.array([2.0, 0.0])
ACTION = jnp.array([0.6, 0.5])


def tracking(variant):
    return AdaptiveTracking(CONFIG, jnp.array(VARIANTS[variant], float))


def observe(task, key, action):
    """The state before an action, and the observation after it."""
    state = task.reset(key, References(REFERENCE, REFERENCE))
    after, _ = task.step(state, action, 33)
    return state, task.observe(after)


@pytest.fixture(scope="module")
def acted():
    task = tracking("adaptive")
    return jax.jit(jax.vmap(lambda key: observe(task, key, ACTION)))(held_out_keys(3))


def test_the_observation_ends_with_the_torque_and_the_following_error(acted):
    states, observations = acted
    assert observations.shape == (3, CONFIG.observations)
    fins = tracking("adaptive").plant
    command = action_to_command(fins.limits, ACTION)

    def measure(state):
        tank, inner = state.plant.fin

        def tick(inner, _):
            inner, reading, channels = tank.measure(inner, command)
            return inner, (channels["torque_nm"], reading.angle)

        return jax.lax.scan(tick, inner, length=33)[1]

    torques, angles = jax.jit(jax.vmap(measure))(states)
    np.testing.assert_allclose(
        observations[:, OWN], torques.mean(axis=1) / TORQUE_SCALE_NM, atol=1e-4
    )
    following = command.angle - angles[:, -1]
    np.testing.assert_allclose(
        ERROR_SCALE_RAD * np.sinh(2 * observations[:, OWN + 1]), following, atol=1e-4
    )
    # Three fins, three loads.
    assert np.ptp(observations[:, OWN]) > 0.01


def test_without_the_senses_the_observation_is_that_of_the_task(acted):
    _, observations = acted
    blind = tracking("blind")
    keys = held_out_keys(3)
    own = jax.jit(jax.vmap(lambda key: observe(blind, key, ACTION)[1]))(keys)
    np.testing.assert_allclose(own[:, :OWN], observations[:, :OWN], atol=1e-5)
    np.testing.assert_array_equal(own[:, OWN:], 0)


def test_the_controller_acts_on_a_fin_as_the_policy_does_in_training(monkeypatch):
    monkeypatch.setattr("studies.adaptive_policy.TEST_S", 4)
    monkeypatch.setattr("studies.adaptive_policy.WINDOW_STARTS_S", (0, 2))
    task = tracking("adaptive")
    policy = Policy.create(jax.random.key(1), PolicyConfig(), CONFIG.observations)
    # A policy that moves and depends on all that it observes.
    policy = eqx.tree_at(
        lambda policy: policy.net.output.kernel, policy, replace_fn=lambda x: 100 * x
    )
    keys = held_out_keys(2)
    controller = AdaptivePolicy(policy, task.visible, CONFIG, task.plant.limits)
    scored = errors(controller, keys, references=((2, 0),))

    def run(key):
        state = task.reset(key, References(REFERENCE, REFERENCE))
        state = state._replace(plant=task.plant.init(key))

        def act(carry, ticks):
            state, memory = carry
            memory, action = policy.act(memory, task.observe(state))
            state, outcome = task.step(state, action, ticks)
            return (state, memory), outcome.forces

        ticks = jnp.asarray(PAPER_CLOCK.action_ticks(12))
        _, forces = jax.lax.scan(act, (state, policy.init()), ticks)
        return drop_padding(forces, 12, PAPER_CLOCK)

    forces = np.asarray(jax.jit(jax.vmap(run))(keys))
    means = np.stack([forces[:, :200].mean(axis=1), forces[:, 200:].mean(axis=1)])
    assert scored.amplitude() > 0.1
    np.testing.assert_allclose(scored.force[:, 0], means - np.array([2, 0]), atol=5e-3)
