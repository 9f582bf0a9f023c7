import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.quantities import TICK_S
from softfin.surrogate.streaming.ensemble import forces
from softfin.surrogate.streaming.segments import Motion
from tests.surrogate.streaming import small

MOTION = small.motion(61)


@functools.partial(jax.jit, static_argnames="wake")
def force_of(net, motion, wake=0.0):
    """From a state whose wake is already moving, if it is asked for."""
    before = jax.tree.map(lambda x: x[0], motion)
    after = jax.tree.map(lambda x: x[1:], motion)
    start = net.start(before)
    start = start._replace(wake=jax.tree.map(lambda x: x + wake, start.wake))
    return jax.lax.scan(lambda state, now: net.step(state, now), start, after)[1]


def force(net, motion, wake=0.0):
    return np.asarray(force_of(net, motion, wake))


def mirror(motion):
    return jax.tree.map(jnp.negative, motion)


@pytest.mark.parametrize("options", [{}, {"wake": 0}])
def test_mirrored_motions_make_mirrored_forces(options):
    net = small.force_net(on_mount=False, **options)
    said = force(net, MOTION)
    np.testing.assert_allclose(force(net, mirror(MOTION)), small.mirrored(said), atol=1e-4)
    assert np.abs(said).max(axis=0).min() > 1


@settings(max_examples=20, deadline=None)
@given(turn=st.floats(-7, 7))
def test_a_motion_that_is_turned_makes_a_force_that_is_turned(turn):
    """The wake of a fin that is turned stands turned in the tank: along and across the fin it is
    the same."""
    net = small.force_net()
    offset = np.asarray(net.offset) * small.SCALES.force_n
    said = force(net, MOTION, 0.7) - offset
    other = force(net, MOTION._replace(angle=MOTION.angle + turn), 0.7) - offset
    np.testing.assert_allclose(other, small.turned(said, turn), atol=2e-3)


def test_a_wake_stands_still_in_the_tank_while_the_fin_turns_and_fades_with_its_time():
    net = small.force_net()
    still = jax.tree.map(jnp.zeros_like, (net.along, net.across))
    net = small.eqx.tree_at(lambda net: (net.along, net.across), net, still)
    state = net.start(Motion(jnp.float32(0.3), jnp.float32(0.0)))
    state = state._replace(wake=state.wake._replace(even=state.wake.even + 1))
    after, _ = net.step(state, Motion(jnp.float32(0.8), jnp.float32(50.0)))

    def in_tank(state):
        return small.turned(np.stack([state.wake.even, state.wake.odd], axis=1), state.motion.angle)

    faded = np.exp(-TICK_S / np.exp(np.asarray(net.log_time)))
    np.testing.assert_allclose(in_tank(after), in_tank(state) * faded[:, None], atol=1e-6)


def quasi_steady():
    """A network that has learnt nothing but its coefficients."""
    net = jax.tree.map(jnp.zeros_like, small.force_net())
    coefficients = jnp.asarray([0.5, 0.2]), jnp.asarray([0.3, -0.4, -0.1])
    return small.eqx.tree_at(lambda net: (net.thrust, net.resistance), net, coefficients)


def test_the_quasi_steady_force_is_along_and_across_the_fin():
    angle, velocity = (np.asarray(part, np.float64) for part in MOTION)
    v = velocity[1:] / small.SCALES.velocity_rad_s
    change = np.diff(velocity) / small.SCALES.change_rad_s
    along = 0.5 * v**2 + 0.2 * v * change
    across = 0.3 * change - 0.4 * v * np.abs(v) - 0.1 * v
    expected = small.SCALES.force_n * small.turned(np.stack([along, across], axis=1), angle[1:])
    np.testing.assert_allclose(force(quasi_steady(), MOTION), expected, atol=1e-4)


def test_the_sensor_turns_and_shifts_what_is_read():
    net = quasi_steady()
    mounted = small.eqx.tree_at(small.MOUNT, net, (jnp.float32(0.2), jnp.asarray([0.1, -0.3])))
    expected = small.turned(force(net, MOTION), 0.2) + small.SCALES.force_n * np.array([0.1, -0.3])
    np.testing.assert_allclose(force(mounted, MOTION), expected, atol=1e-5)


def test_forces_is_step_by_step():
    net = small.force_net()
    said = jax.jit(forces)(net, MOTION)
    np.testing.assert_allclose(said, force(net, MOTION), atol=1e-5)
