"""The reward against plain NumPy over the samples that count."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.window import moving_average, sobolev, window_mean
from softfin.gaits.reachable import Cell
from softfin.task.references import References
from softfin.task.task import ForceTracking, RewardConfig, RewardTerms, TaskConfig
from tests.plants import DrivenFin

FORCES = np.random.default_rng(0).normal(0, 4, (200, 2)).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(count=st.integers(2, 200))
def test_only_the_samples_since_the_reset_count(count: int) -> None:
    made = FORCES[-count:]
    reference = np.array([1.0, -2.0], np.float32)
    steps = np.diff(made, axis=0)

    error = window_mean(jnp.asarray(FORCES), jnp.int32(count)) - jnp.asarray(reference)

    np.testing.assert_allclose(error, made.mean(axis=0) - reference, atol=1e-5)
    np.testing.assert_allclose(
        sobolev(jnp.asarray(FORCES), jnp.int32(count), "sum"),
        np.linalg.norm(steps, axis=0),
        rtol=1e-5,
    )
    np.testing.assert_allclose(
        sobolev(jnp.asarray(FORCES), jnp.int32(count), "mean"),
        np.sqrt((steps**2).mean(axis=0)),
        rtol=1e-5,
    )


def test_a_single_sample_has_a_mean_and_no_roughness() -> None:
    forces = jnp.asarray(FORCES)
    one = jnp.int32(1)
    np.testing.assert_allclose(window_mean(forces, one), FORCES[-1])
    np.testing.assert_array_equal(sobolev(forces, one, "sum"), [0, 0])
    np.testing.assert_array_equal(sobolev(forces, one, "mean"), [0, 0])


def test_the_two_forms_differ_by_the_root_of_the_number_of_steps() -> None:
    forces = jnp.asarray(FORCES)
    full = jnp.int32(200)
    np.testing.assert_allclose(
        sobolev(forces, full, "sum"), np.sqrt(199) * sobolev(forces, full, "mean"), rtol=1e-5
    )


def test_the_reward_is_the_negative_weighted_sum_over_the_axes() -> None:
    error = jnp.array([0.5, 2.0])
    smoothness = jnp.array([3.0, 4.0])
    terms = RewardTerms(error, smoothness)
    value = RewardConfig(weight=(1.0, 10.0), smoothness=(0.1, 0.2)).value(terms)
    assert float(value) == pytest.approx(-(1 * (0.5 + 0.1 * 3) + 10 * (2 + 0.2 * 4)))
    many = RewardConfig().value(RewardTerms(*(jnp.tile(x, (3, 4, 1)) for x in terms[:2])))
    assert many.shape == (3, 4)


def test_a_fin_at_rest_has_a_finite_slope() -> None:
    slope = jax.grad(lambda f: sobolev(f, jnp.int32(200), "sum").sum())(jnp.zeros((200, 2)))
    assert np.isfinite(slope).all()


def test_the_moving_average_is_the_mean_of_every_whole_window() -> None:
    average = moving_average(jnp.asarray(FORCES), 30)
    expected = [FORCES[i : i + 30].mean(axis=0) for i in range(171)]
    np.testing.assert_allclose(average, expected, atol=1e-4)


def test_power_has_its_weight() -> None:
    """The mean power of the action; a fin without torque has none."""
    rewards = {}
    for weight in (0.0, 0.5):
        task = ForceTracking(DrivenFin(), TaskConfig(reward={"power": weight}))
        state = task.reset(jax.random.key(0), References.of(Cell(low=(1, -1), high=(3, 1))))
        rewards[weight] = jax.jit(task.step)(state, jnp.array([0.5, 0.9]), 33)[1]
    assert rewards[0.0].terms.power is None
    power = float(rewards[0.5].terms.power)
    # A stroke of 0.8 rad at up to 3 rad/s, against |speed|^3 / 5.
    assert 0.5 < power < 5.4
    assert float(rewards[0.5].reward) == pytest.approx(float(rewards[0.0].reward) - 0.5 * power)
