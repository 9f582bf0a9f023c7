import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.quantities import TICK_S, Command
from softfin.surrogate.streaming.core import products
from softfin.surrogate.streaming.drive import FollowingNet, FreeNet
from softfin.surrogate.streaming.force import Motion
from softfin.surrogate.streaming.member import motions
from softfin.surrogate.streaming.profile import LONGEST_DELAY
from tests.surrogate.streaming import small

COMMANDS = Command(*map(jnp.asarray, small.commands(120, seed=1)))
BEFORE = Motion(jnp.float32(0.2), jnp.float32(0.5))
WAITING = Command(jnp.linspace(-0.5, 0.5, LONGEST_DELAY), jnp.full(LONGEST_DELAY, 2.0))
run = eqx.filter_jit(motions)


def flipped(angles_and_speeds):
    return angles_and_speeds._replace(angle=-angles_and_speeds.angle)


def mirrored_run(net):
    return run(net, jax.tree.map(jnp.negative, BEFORE), flipped(WAITING), flipped(COMMANDS))


@pytest.mark.parametrize("profile", [True, False])
def test_mirrored_commands_make_mirrored_motions(profile):
    net = small.drive_net(profile=profile)
    said, other = run(net, BEFORE, WAITING, COMMANDS), mirrored_run(net)
    for one, mirror in zip(said, other, strict=True):
        np.testing.assert_allclose(mirror, -one, atol=1e-5)
    assert np.abs(said.angle).max() > 0.1


@pytest.mark.parametrize("profile", [True, False])
def test_without_the_symmetry_they_do_not(profile):
    net = small.drive_net(profile=profile, mirror=False)
    said, other = run(net, BEFORE, WAITING, COMMANDS), mirrored_run(net)
    assert np.abs(other.angle + said.angle).max() > 1e-3


def test_a_net_that_follows_says_the_profile_before_it_has_learnt():
    net = small.drive_net()
    silent = eqx.tree_at(lambda net: net.core, net, replace_fn=lambda core: jax.tree.map(jnp.zeros_like, core))
    still = Motion(jnp.float32(0.0), jnp.float32(0.0))
    waiting = Command(jnp.zeros(LONGEST_DELAY), jnp.ones(LONGEST_DELAY))
    said, profile = run(silent, still, waiting, COMMANDS), small.followed(net.profile, COMMANDS)
    np.testing.assert_allclose(said.angle[:-1], profile.angle[1:], atol=1e-6)
    np.testing.assert_allclose(said.velocity[:-1], profile.velocity[1:], atol=1e-6)
    assert np.abs(run(net, still, waiting, COMMANDS).angle - said.angle).max() > 1e-3


def test_a_net_that_knows_no_profile_says_velocities_whose_integral_is_the_angle():
    said = run(small.drive_net(profile=False), BEFORE, WAITING, COMMANDS)
    mean = (said.velocity[1:] + said.velocity[:-1]) / 2
    np.testing.assert_allclose(np.diff(said.angle), TICK_S * mean, atol=1e-5)


def test_a_free_net_holds_no_profile_at_all():
    free, following = small.drive_net(profile=False), small.drive_net()
    assert isinstance(free, FreeNet)
    assert isinstance(following, FollowingNet)
    assert not hasattr(free, "profile")


def test_products_are_those_of_the_core():
    # 3 units and 4 hidden; following: 3 odd inputs, 1 even, 2 odd outputs. Free: 2 odd inputs, 1 odd output.
    assert products(small.drive_net()) == 6 * 6 + 7 * 12 + 6 * 4 + 3 * 2 + 4 * 6
    assert products(small.drive_net(profile=False)) == 5 * 6 + 7 * 12 + 6 * 4 + 3 + 4 * 3
