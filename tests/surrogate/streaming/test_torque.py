"""The torque of a streaming surrogate, and the power that follows from it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.plant import has_torque
from softfin.core.quantities import Command
from softfin.surrogate import load_surrogate, save_surrogate
from softfin.surrogate.streaming.ensemble import predict_motion
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.streaming.torque import (
    TORQUE,
    fit_torque,
    power_means,
    predict_power,
    with_torque,
)
from tests.surrogate.streaming import small

MEMBERS = small.members()
BURN_IN = 20


def recorded(seed, noise_nm=0.0, offset_nm=0.0):
    """A log whose torque is the drag of the shaft's own velocity, which the rates contain."""
    log = small.recorded(900, seed)
    (motion,) = predict_motion(MEMBERS.drive, [log])
    velocity = np.asarray(motion.velocity).mean(axis=0)
    torque = 0.3 * velocity * np.abs(velocity) + 0.1 * velocity + offset_nm
    noise = np.random.default_rng(seed).normal(0, noise_nm, len(torque))
    reading = log.reading._replace(velocity=velocity.astype(np.float32))
    return log._replace(reading=reading, channels={TORQUE: (torque + noise).astype(np.float32)})


LOGS = [recorded(seed, noise_nm=0.05, offset_nm=0.4) for seed in range(8)]


def pairs(logs):
    return with_torque(predict_motion(MEMBERS.drive, logs), logs)


@pytest.fixture(scope="module")
def fitted():
    return fit_torque(MEMBERS.force, pairs(LOGS[:5]), pairs(LOGS[5:]), BURN_IN)


def test_the_power_of_unseen_logs_is_predicted_whatever_the_offset_of_the_sensor(fitted):
    nets, _ = fitted
    unseen = [recorded(seed) for seed in range(20, 24)]
    means, measured = power_means(nets, pairs(unseen), BURN_IN)
    np.testing.assert_allclose(means.mean(axis=0), measured, rtol=0.05, atol=0.01)


def test_the_interval_contains_the_means_of_logs_of_its_kind(fitted):
    nets, interval = fitted
    more = [recorded(seed, noise_nm=0.05, offset_nm=0.4) for seed in range(30, 50)]
    means, measured = power_means(nets, pairs(more), BURN_IN)
    inside = np.abs(means.mean(axis=0) - measured) <= interval.half_width(means)
    assert 0.8 <= inside.mean() <= 1.0
    assert interval.logs == 3


def test_the_torque_of_a_mirrored_motion_has_the_other_sign(fitted):
    nets, _ = fitted
    motion = jax.tree.map(lambda x: jnp.stack([x, x]), small.motion(80))
    mirrored = jax.tree.map(jnp.negative, motion)
    one, other = (predict_power(nets, each) for each in (motion, mirrored))
    # The velocity changes its sign as well, so the power does not.
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    assert np.abs(one).max() > 0.1


def test_forces_do_not_depend_on_the_torque(fitted):
    nets, _ = fitted
    for name in ("core", "along", "across", "thrust", "resistance"):
        for one, other in zip(
            *(jax.tree.leaves(getattr(each, name)) for each in (nets, MEMBERS.force)), strict=True
        ):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("first", "last"), [(5, 5), (0, 3)])
def test_without_logs_of_the_torque_there_is_none(fitted, first, last):
    """Whether training logs or held-out logs lack it, and of a refit, which starts with one."""
    nets, interval = fit_torque(fitted[0], pairs(LOGS[:first]), pairs(LOGS[last:3]), BURN_IN)
    assert nets.torque is None
    assert interval is None


def test_a_log_with_gaps_in_its_torque_is_not_used():
    channel = np.array(LOGS[0].channels[TORQUE])
    channel[7] = np.nan
    broken = LOGS[0]._replace(channels={TORQUE: channel})
    plain = LOGS[1]._replace(channels={})
    assert len(pairs([broken, plain, LOGS[2]])) == 1


def driven(fitted):
    nets, interval = fitted
    plain = small.surrogate()
    members = eqx.tree_at(lambda each: each.force, MEMBERS, nets)
    return StreamingSurrogate(members, plain.limits, plain.interval, plain.familiarity, interval)


def test_the_plant_and_the_logs_have_the_same_power(fitted):
    """What the plant says tick by tick is what the free run over a log says."""
    surrogate = driven(fitted)
    commands = small.commands(150)
    state = surrogate.init(jax.random.key(0))
    velocity = []
    torque = []
    advance = jax.jit(lambda state, command: surrogate.advance(state, command, 1))
    for angle, speed in zip(*commands, strict=True):
        state, reading = advance(state, Command(angle, speed))
        velocity.append(float(reading.velocity[0]))
        torque.append(np.asarray(surrogate.torque(state)))
    torque = np.array(torque)
    assert np.isnan(torque[:, 1]).all()
    drag = 0.3 * np.array(velocity) * np.abs(velocity) + 0.1 * np.array(velocity)
    assert np.corrcoef(torque[20:, 0], drag[20:])[0, 1] > 0.98


def test_scores_are_those_of_the_mean_power(fitted):
    scores = driven(fitted).power_scores([recorded(60), recorded(61)._replace(channels={})])
    assert scores["logs"] == 1
    assert 0 < scores["rmse_w"] < 0.05 * scores["mean_w"]
    assert 0 <= scores["coverage"] <= 1
    assert small.surrogate().power_scores([recorded(60)]) is None


def test_it_is_stored_with_its_interval_and_older_surrogates_load_without(tmp_path, fitted):
    for name, surrogate in (("new", driven(fitted)), ("old", small.surrogate())):
        save_surrogate(tmp_path / name, surrogate, None, {})
    loaded = load_surrogate(tmp_path / "new")
    assert loaded.power_interval == fitted[1]
    np.testing.assert_array_equal(loaded.members.force.torque, fitted[0].torque)
    assert has_torque(loaded)
    assert not has_torque(load_surrogate(tmp_path / "old"))
    assert load_surrogate(tmp_path / "old").power_interval is None
