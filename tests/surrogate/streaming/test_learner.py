from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.surrogate import StreamingConfig
from softfin.surrogate.streaming import fit as module
from softfin.surrogate.streaming.ensemble import forces
from softfin.surrogate.streaming.fit import StreamingLearner, drive_loss, force_loss
from softfin.surrogate.streaming.segments import Motion, Table
from softfin.surrogate.training import keep_best_nets
from tests.surrogate.streaming import small

CONFIG = small.CONFIG
TABLE = Table.of([small.recorded(200, seed) for seed in range(3)], CONFIG.ticks)
SEGMENTS = TABLE.draw(jax.random.key(0), CONFIG.batch, CONFIG.ticks)
KEY = jax.random.key(1)


def predicted(shift=0.3):
    """Another motion than was measured."""
    return Motion(SEGMENTS.motion.angle + shift, SEGMENTS.motion.velocity * (1 + shift))


@eqx.filter_jit
def force_error(net, segments, motion, done):
    return force_loss(net, segments, motion, jnp.float32(done), KEY, CONFIG)


@eqx.filter_jit
def drive_error(net, segments):
    return drive_loss(net, segments, predicted(), jnp.float32(0), KEY, CONFIG)


def slopes(function, net):
    return dict(jax.tree_util.tree_leaves_with_path(jax.jit(jax.grad(function))(net)))


def test_gradients_reach_every_weight_of_a_force_net():
    net = small.force_net()
    found = slopes(
        lambda net: force_loss(net, SEGMENTS, predicted(), jnp.float32(0.5), KEY, CONFIG), net
    )
    assert [jax.tree_util.keystr(path) for path, slope in found.items() if not np.all(slope)] == []


def test_gradients_reach_every_weight_of_a_drive_net_and_none_of_its_profile():
    net = small.drive_net()
    found = slopes(
        lambda net: drive_loss(net, SEGMENTS, predicted(), jnp.float32(0), KEY, CONFIG), net
    )
    names = {jax.tree_util.keystr(path): slope for path, slope in found.items()}
    coefficients = {name for name in names if name.startswith(".profile")}
    assert len(coefficients) == 7
    assert [
        name for name, slope in names.items() if name not in coefficients and not np.all(slope)
    ] == []
    assert [name for name in coefficients if names[name] != 0] == []


@pytest.mark.parametrize("part", ["force", "motion"])
def test_what_is_wrong_within_the_burn_in_does_not_count(part):
    def with_error(tick):
        if part == "force":
            return SEGMENTS._replace(force=SEGMENTS.force.at[:, tick].add(5.0))
        return SEGMENTS._replace(
            motion=SEGMENTS.motion._replace(angle=SEGMENTS.motion.angle.at[:, 1 + tick].add(5.0))
        )

    def error(segments):
        if part == "force":
            return float(force_error(small.force_net(), segments, predicted(), 0.0))
        return float(drive_error(small.drive_net(), segments))

    assert error(with_error(CONFIG.burn_in - 1)) == pytest.approx(error(SEGMENTS), rel=1e-6)
    assert error(with_error(CONFIG.burn_in)) > 1.01 * error(SEGMENTS)


def test_force_nets_see_the_measured_motion_first_and_the_predicted_one_in_the_end():
    net, begin, end = small.force_net(), *CONFIG.free_running
    told = predicted()
    fed = SEGMENTS._replace(motion=told)
    measured, free = (
        float(force_error(net, segments, predicted(0.0), 0.0)) for segments in (SEGMENTS, fed)
    )
    assert abs(free - measured) > 0.05 * measured
    for done, expected in ((0.0, measured), (begin, measured), (end, free), (1.0, free)):
        assert float(force_error(net, SEGMENTS, told, done)) == pytest.approx(expected, rel=1e-5)
    between = float(force_error(net, SEGMENTS, told, (begin + end) / 2))
    assert abs(between - measured) > 1e-4
    assert abs(between - free) > 1e-4


@pytest.fixture(scope="module")
def learner():
    return StreamingLearner(force_loss, CONFIG, 8)


def test_each_member_draws_and_learns_for_itself_and_the_best_weights_of_each_are_kept(learner):
    twins = jax.tree.map(lambda x: jnp.stack([x, x]), small.force_net())
    nowhere = Motion(*(jnp.zeros((2, 600)) for _ in range(2)))
    ((state, loss),) = learner.run(learner.start(twins), TABLE, nowhere, [(0, 4)], KEY)
    assert loss[0] != loss[1]
    moved = [
        np.asarray(new - old)
        for new, old in zip(*map(jax.tree.leaves, (state.nets, twins)), strict=True)
    ]
    assert all(np.abs(x[0] - x[1]).max() > 0 for x in moved if x.size)

    first, better = keep_best_nets(state, loss, jnp.asarray([1.0, 2.0]), "nets")
    assert better
    further = first._replace(nets=jax.tree.map(lambda x: x + 1, first.nets))
    later, better = keep_best_nets(further, loss, jnp.asarray([3.0, 0.5]), "nets")
    assert better
    assert not keep_best_nets(later, loss, jnp.asarray([1.0, 0.5]), "nets")[1]
    np.testing.assert_array_equal(later.best_loss, [1.0, 0.5])
    np.testing.assert_array_equal(later.best.offset[0], state.nets.offset[0])
    np.testing.assert_array_equal(later.best.offset[1], state.nets.offset[1] + 1)


def trained(learner):
    """Weights and loss of each member after 8 updates."""
    nowhere = Motion(*(jnp.zeros((2, 600)) for _ in range(2)))
    start = learner.start(small.members().force)
    *_, (state, loss) = learner.run(start, TABLE, nowhere, [(0, 4), (4, 4)], KEY)
    return [np.asarray(leaf) for leaf in jax.tree.leaves((state.nets, loss))]


def test_members_in_threads_learn_the_same_to_the_last_bit_as_one_after_the_other(
    learner, monkeypatch
):
    found = []
    for cores in (1, 4):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found.append(trained(learner))
    for alone, together in zip(*found, strict=True):
        np.testing.assert_array_equal(alone, together)


def test_the_loss_is_to_5_digits_that_of_training_by_the_plain_loop(learner, monkeypatch):
    *_, fast = trained(learner)
    monkeypatch.setattr(
        module, "segment_forces", lambda net, motion: jax.vmap(partial(forces, net))(motion)
    )
    *_, plain = trained(StreamingLearner(force_loss, CONFIG, 8))
    np.testing.assert_allclose(fast, plain, rtol=1e-5)


def test_two_calls_are_one_compiled_program(learner, monkeypatch):
    compiled = []
    loss = learner.loss

    def counted(*args):
        compiled.append(1)
        return loss(*args)

    monkeypatch.setattr(learner, "loss", counted)
    state = learner.start(small.members().force)
    nowhere = Motion(*(jnp.zeros((2, 600)) for _ in range(2)))
    for first in (0, 1):
        ((state, _),) = learner.run(state, TABLE, nowhere, [(first, 4)], KEY)
        state, _ = keep_best_nets(state, jnp.ones(2), jnp.asarray([1.0, 2.0], jnp.float32), "nets")
        once = len(compiled) if first == 0 else once
    assert len(compiled) == once


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("burn_in=400", r"burn_in must be less than ticks = 250"),
        (
            "free_running=[0.8, 0.2]",
            r"two fractions from 0 to 1 in ascending order, e\.g\. 0\.2, 0\.8",
        ),
        ("free_running=[0.5, 1.2]", r"two fractions from 0 to 1 in ascending order"),
        ("members=0", r"members = 0: Input should be greater than 0"),
        ("force.unit=3", r"did you mean 'units'"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, words):
    with pytest.raises(ConfigurationError, match=words):
        StreamingConfig().changed([change])
