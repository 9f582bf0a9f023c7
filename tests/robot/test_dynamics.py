"""The rigid body against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

from softfin.core.errors import ConfigurationError
from softfin.robot.body_config import GRAVITY_M_S2, BodyConfig
from softfin.robot.dynamics import BodyState, Dynamics
from softfin.robot.rotation import from_euler, matrix, to_vector

SPHERE = {"mass_kg": 10.0, "inertia_kg_m2": (0.2, 0.4, 0.5)}


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def run(config, state, seconds, wrench=(0.0,) * 6, current=(0.0,) * 3, step_s=0.01):
    """States after each step, the first among them."""
    dynamics = Dynamics.of(config)
    wrench = jnp.asarray(wrench, float)
    current = jnp.asarray(current, float)

    @jax.jit
    def all_of_it(state):
        def step(state, _):
            after = dynamics.step(state, wrench, current, step_s)
            return after, state

        return jax.lax.scan(step, state, length=round(seconds / step_s) + 1)[1]

    return dynamics, all_of_it(jax.tree.map(lambda x: jnp.asarray(x, float), state))


def moving(twist, attitude=(1.0, 0.0, 0.0, 0.0)):
    return BodyState(jnp.zeros(3), jnp.asarray(attitude, float), jnp.asarray(twist, float))


@pytest.mark.parametrize("axis", range(6))
def test_a_steady_wrench_ends_in_the_speed_at_which_drag_balances_it(axis):
    config = BodyConfig(**SPHERE, drag_linear=(4.0,) * 6, drag_quadratic=(30.0,) * 6)
    _, states = run(config, moving(np.zeros(6)), 60, wrench=2.0 * np.eye(6)[axis])
    assert states.twist[-1, axis] == pytest.approx((-4 + np.sqrt(16 + 4 * 30 * 2)) / 60, rel=1e-6)


def test_a_body_left_alone_ends_with_the_current():
    config = BodyConfig(
        **SPHERE,
        drag_linear=(4.0,) * 6,
        drag_quadratic=(30.0,) * 6,
        added_mass=(3, 20, 40, 0, 0, 0),
    )
    _, states = run(
        config, moving(np.zeros(6), from_euler(0.4, 0.2, 1.0)), 200, current=(0.1, -0.2, 0.05)
    )
    np.testing.assert_allclose(
        matrix(states.attitude[-1]) @ states.twist[-1, :3], (0.1, -0.2, 0.05), atol=1e-6
    )


def test_in_a_current_a_body_that_turns_moves_as_in_still_water_and_is_carried_along():
    config = BodyConfig(
        **SPHERE,
        drag_linear=(4.0,) * 6,
        drag_quadratic=(30.0,) * 6,
        added_mass=(3, 20, 40, 0, 0, 0),
    )
    current = np.array([0.2, -0.1, 0.05])
    attitude = from_euler(0.4, 0.2, 1.0)
    twist = np.array([0.3, 0.1, -0.2, 0.4, -0.5, 0.9])
    carried_twist = twist + np.concatenate([current @ matrix(attitude), np.zeros(3)])
    wrench = (1.0, 0.5, -0.3, 0.2, 0.3, 1.0)
    _, still = run(config, moving(twist, attitude), 2, wrench)
    _, carried = run(config, moving(carried_twist, attitude), 2, wrench, current)
    times = 0.01 * np.arange(len(still.position))
    np.testing.assert_allclose(
        carried.position, still.position + times[:, None] * current, atol=1e-6
    )
    np.testing.assert_allclose(carried.attitude, still.attitude, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_roll_and_pitch_swing_with_the_period_of_a_pendulum(axis):
    config = BodyConfig(
        **SPHERE,
        added_mass=(0, 0, 0, 0.1, 0.2, 0),
        centre_of_gravity_m=(0, 0, -0.02),
        centre_of_buoyancy_m=(0, 0, 0.03),
    )
    angles = 0.01 * np.eye(3)[axis]
    _, states = run(config, moving(np.zeros(6), from_euler(*angles)), 30)
    angle = np.array([to_vector(np.asarray(q))[axis] for q in states.attitude])
    # The centre of gravity swings along, unless something holds the origin; so it is about the
    # centre of gravity.
    inertia = (0.3, 0.6)[axis]
    frequency = np.sqrt(config.mass_kg * GRAVITY_M_S2 * 0.05 / inertia)
    crossings = np.flatnonzero(np.diff(np.sign(angle)) < 0)
    period = np.diff(crossings).mean() * 0.01
    assert period == pytest.approx(2 * np.pi / frequency, rel=0.01)


def test_in_an_ideal_fluid_momentum_and_energy_are_conserved():
    config = BodyConfig(
        **SPHERE, added_mass=(2, 15, 30, 0.1, 0.3, 0.2), centre_of_gravity_m=(0, 0, 0)
    )
    dynamics, states = run(config, moving([0.5, 0.3, -0.2, 0.4, -0.6, 0.8]), 20, step_s=0.002)
    momentum = states.twist @ dynamics.inertia
    axes = jax.vmap(matrix)(states.attitude)
    linear = jnp.einsum("tij,tj->ti", axes, momentum[:, :3])
    angular = jnp.einsum("tij,tj->ti", axes, momentum[:, 3:]) + jnp.cross(states.position, linear)
    energy = (states.twist * momentum).sum(1) / 2
    for kept in (linear, angular, energy):
        np.testing.assert_allclose(kept, jnp.broadcast_to(kept[0], kept.shape), atol=1e-7)


def test_a_body_that_drifts_broadside_on_is_turned_by_munk_s_moment():
    config = BodyConfig(**SPHERE, added_mass=(2, 22, 0, 0, 0, 0))
    found = Dynamics.of(config).gyroscopic(jnp.asarray([0.3, 0.2, 0, 0, 0, 0]))
    assert found[5] == pytest.approx((2 - 22) * 0.3 * 0.2)


def test_a_torque_free_body_turns_by_jacobi_s_elliptic_functions():
    # Landau and Lifshitz, Mechanics, sec. 37.
    one, two, three = SPHERE["inertia_kg_m2"]
    start = np.array([0.6, 0.0, 1.0])
    energy = (np.array([one, two, three]) * start**2).sum()
    squared = ((np.array([one, two, three]) * start) ** 2).sum()
    _, states = run(BodyConfig(**SPHERE), moving([0, 0, 0, *start]), 20, step_s=0.005)
    times = 0.005 * np.arange(len(states.twist))
    rate = np.sqrt((three - two) * (squared - energy * one) / (one * two * three))
    m = (two - one) * (energy * three - squared) / ((three - two) * (squared - energy * one))
    sn, cn, dn, _ = ellipj(rate * times, m)
    found = np.abs(states.twist[:, 3:])
    expected = np.abs(
        np.stack(
            [
                start[0] * cn,
                np.sqrt((energy * three - squared) / (two * (three - two))) * sn,
                start[2] * dn,
            ],
            axis=1,
        )
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inertia_kg_m2": (0.2, 0.0, 0.5)}, "singular"),
        ({"inertia_kg_m2": (0.1, 0.1, 0.5)}, "sum of the other two"),
        ({"inertia_kg_m2": ((1, 0.2, 0), (0, 1, 0), (0, 0, 1))}, "not symmetric"),
        ({"mass_kg": -1}, "mass_kg"),
    ],
)
def test_what_is_no_body_is_refused_in_a_line(change, words):
    with pytest.raises(ConfigurationError, match=words):
        BodyConfig.build(SPHERE | change)
