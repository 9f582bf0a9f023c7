"""The forces of training, whose gradient is not what automatic differentiation makes of a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.surrogate.streaming.ensemble import forces
from softfin.surrogate.streaming.segment_forces import segment_forces
from softfin.surrogate.streaming.segments import Motion
from tests.surrogate.streaming import small

TICKS = 40
BATCH = 3
MOTION: Motion = jax.tree.map(
    lambda *x: jnp.stack(x), *(small.motion(1 + TICKS, seed) for seed in range(BATCH))
)
WEIGHTS = np.random.default_rng(0).normal(size=(BATCH, TICKS, 2))
"""Of the forces in a loss."""


def plain_forces(net, motion):
    return jax.vmap(lambda one: forces(net, one))(motion)


def loss_by(predict):
    def loss(net, motion):
        return jnp.sum(predict(net, motion) * WEIGHTS)

    return loss


def named(tree):
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


@pytest.mark.parametrize("options", [{}, {"wake": 0}])
def test_forces_of_segments_are_those_of_each_tick_by_tick(options):
    net = small.force_net(**options)
    predicted = jax.jit(segment_forces)(net, MOTION)
    assert predicted.shape == (BATCH, TICKS, 2)
    np.testing.assert_allclose(predicted, jax.jit(plain_forces)(net, MOTION), atol=1e-5)


@pytest.mark.parametrize("options", [{}, {"wake": 0}])
def test_the_gradient_is_that_of_the_plain_loop(options):
    """With respect to every weight, and to the motion."""
    net = small.force_net(**options)
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (net, MOTION))
        fast, plain = (
            named(jax.jit(jax.grad(loss_by(predict), argnums=(0, 1)))(*exact))
            for predict in (segment_forces, plain_forces)
        )
    assert fast.keys() == plain.keys()
    for name, slope in plain.items():
        np.testing.assert_allclose(fast[name], slope, rtol=1e-8, atol=1e-10, err_msg=name)


def test_the_gradient_is_that_of_finite_differences():
    random = np.random.default_rng(1)
    step = 1e-6
    with jax.enable_x64(True):
        net = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), small.force_net())
        motion = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), MOTION)
        loss = jax.jit(loss_by(segment_forces))
        slopes = jax.jit(jax.grad(loss))(net, motion)
        leaves, structure = jax.tree.flatten(net)
        for index, slope in enumerate(jax.tree.leaves(slopes)):
            direction = random.normal(size=slope.shape)

            def shifted(size, index=index, direction=direction):
                moved = [*leaves]
                moved[index] = leaves[index] + size * direction
                return float(loss(jax.tree.unflatten(structure, moved), motion))

            difference = (shifted(step) - shifted(-step)) / (2 * step)
            expected = float(jnp.sum(slope * direction))
            assert difference == pytest.approx(expected, rel=1e-5, abs=1e-6)
