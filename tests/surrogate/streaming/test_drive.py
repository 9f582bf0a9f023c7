import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import Command
from softfin.surrogate.streaming.ensemble import motions
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion
from tests.surrogate.streaming import small

COMMANDS = Command(*map(jnp.asarray, small.commands(120, seed=1)))
BEFORE = Motion(jnp.float32(0.2), jnp.float32(0.5))
WAITING = Command(jnp.linspace(-0.5, 0.5, MAX_DELAY), jnp.full(MAX_DELAY, 2.0))
run = eqx.filter_jit(motions)


def flipped(angles_and_speeds):
    return angles_and_speeds._replace(angle=-angles_and_speeds.angle)


def mirrored_run(net):
    return run(net, jax.tree.map(jnp.negative, BEFORE), flipped(WAITING), flipped(COMMANDS))


def test_mirrored_commands_make_mirrored_motions():
    net = small.drive_net()
    said = run(net, BEFORE, WAITING, COMMANDS)
    other = mirrored_run(net)
    for one, mirror in zip(said, other, strict=True):
        np.testing.assert_allclose(mirror, -one, atol=1e-5)
    assert np.abs(said.angle).max() > 0.1


def test_a_net_that_follows_says_the_profile_before_it_has_learnt():
    net = small.drive_net()
    silent = eqx.tree_at(
        lambda net: net.core, net, replace_fn=lambda core: jax.tree.map(jnp.zeros_like, core)
    )
    still = Motion(jnp.float32(0.0), jnp.float32(0.0))
    waiting = Command(jnp.zeros(MAX_DELAY), jnp.ones(MAX_DELAY))
    said = run(silent, still, waiting, COMMANDS)
    profile = small.followed(net.profile, COMMANDS)
    np.testing.assert_allclose(said.angle[:-1], profile.angle, atol=1e-6)
    np.testing.assert_allclose(said.velocity[:-1], profile.velocity, atol=1e-6)
    assert np.abs(run(net, still, waiting, COMMANDS).angle - said.angle).max() > 1e-3
