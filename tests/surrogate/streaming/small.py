"""Streaming networks small enough for tests, with random weights everywhere, and logs of a fin that
is known."""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Log, Reading
from softfin.surrogate import StreamingConfig, StreamingSurrogate
from softfin.surrogate.streaming.ensemble import (
    Familiarity,
    Interval,
    ensemble,
    forces,
    predict_force,
    predict_motion,
    remembered,
    single,
)
from softfin.surrogate.streaming.nets import DriveNetConfig, ForceNetConfig
from softfin.surrogate.streaming.profile import Profile
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, Scales

SCALES = Scales(angle_rad=0.8, velocity_rad_s=2.0, change_rad_s=0.25, force_n=2.0)
DRIVE = DriveNetConfig(units=3, hidden=4)
FORCE = ForceNetConfig(units=3, hidden=4, wake=2)
PROFILE = Profile(delay=2.5, acceleration=60.0)
CONFIG = StreamingConfig(
    drive=DRIVE,
    force=FORCE,
    members=2,
    drive_updates=10,
    force_updates=10,
    batch=8,
    ticks=40,
    burn_in=10,
)
MOUNT = lambda net: (net.mount_turn, net.offset)  # noqa: E731
"""What a force network knows of the sensor, to which no symmetry of the fin applies."""


def filled(tree, seed=0, spread=0.5):
    """With noise on every number, for networks say nothing before they have learnt something."""
    leaves, structure = jax.tree.flatten(tree)
    random = np.random.default_rng(seed)
    noisy = [np.asarray(leaf) + np.float32(random.normal(0, spread, leaf.shape)) for leaf in leaves]
    return jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in noisy])


def members(count=2, drive=DRIVE, force=FORCE, profile=PROFILE, seed=0, spread=0.5):
    """An ensemble whose weights are noise, but not the profile's coefficients and the wake's
    times."""
    # Not drawn as for a fit: to compile that takes longer than most tests.
    shapes = jax.eval_shape(
        lambda key: ensemble(count, drive, force, SCALES, key), jax.random.key(seed)
    )
    noise = filled(
        jax.tree.map(lambda leaf: np.zeros(leaf.shape, np.float32), shapes), seed, spread
    )

    def known(members):
        return (members.force.log_time, members.drive.profile)

    def of_each(leaf):
        return jnp.asarray(np.stack([np.asarray(leaf, np.float32)] * count))

    times = np.log(np.geomspace(0.05, 1.5, force.wake))
    return eqx.tree_at(known, noise, jax.tree.map(of_each, (times, profile)))


def drive_net(seed=0, **options):
    return single(members(1, drive=DRIVE.merged(options, "test"), seed=seed)).drive


def force_net(seed=0, on_mount=True, **options):
    """Where it is not on its mount, the sensor is neither turned nor off zero."""
    net = single(members(1, force=FORCE.merged(options, "test"), seed=seed)).force
    return net if on_mount else eqx.tree_at(MOUNT, net, replace_fn=jnp.zeros_like)


def interval():
    return Interval(coverage=0.9, factor=1.6, floor_n=0.05, windows=10, logs=10)


@functools.cache
def surrogate(seed=0):
    nets = members(seed=seed)
    size = remembered(single(nets.force).start(Motion(jnp.zeros(()), jnp.zeros(())))).size
    return StreamingSurrogate(
        nets, PAPER_LIMITS, interval(), Familiarity(jnp.zeros(size), jnp.eye(size))
    )


def commands(rows, seed=0, reach=1.5, speeds=(1.0, 3.0), held=(15, 60)):
    """Random ones, held for a random number of rows."""
    random = np.random.default_rng(seed)
    count = rows // held[0] + 1
    ticks = random.integers(*held, count)
    angle = random.uniform(-reach, reach, count)
    velocity = random.uniform(*speeds, count)
    return Command(
        *(np.repeat(part, ticks)[:rows].astype(np.float32) for part in (angle, velocity))
    )


@jax.jit
def followed(profile, commands):
    """The motion of a drive at rest that follows its profile: of row k what command k - 1 leads
    to."""
    still = Motion(jnp.zeros(()), jnp.zeros(()))
    waiting = Command(jnp.zeros(MAX_DELAY), jnp.ones(MAX_DELAY))

    def step(state, command):
        return profile.step(state, command)[0], profile.shaft(state.motion)

    return jax.lax.scan(step, profile.start(still, waiting), commands)[1]


def recorded(rows, seed=0, profile=PROFILE, sided=False, noise_n=0.01, noise_rad=0.0, **options):
    """Thrust v^2 / 4 and drag v |v| / 3 along and across the fin; `sided`: thrust v / 2 instead,
    which has a sign."""
    issued = commands(rows, seed, **options)
    angle, velocity = map(np.asarray, followed(profile, issued))
    random = np.random.default_rng(seed + 1000)
    along = velocity / 2 if sided else velocity**2 / 4
    across = -velocity * np.abs(velocity) / 3
    force = turned(np.stack([along, across], axis=1), angle) + random.normal(0, noise_n, (rows, 2))
    time = np.arange(rows) * TICK_S
    angle = angle + random.normal(0, noise_rad, rows)
    return Log(issued, Reading(*(x.astype(np.float32) for x in (time, angle, velocity, force))))


def turned(force, angle):
    """Forces (x, y) of a fin that is turned by an angle: thrust goes along (cos, -sin)."""
    x = force[..., 0]
    y = force[..., 1]
    cos = np.cos(angle)
    sin = np.sin(angle)
    return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)


def predict_logs(members, logs):
    """Motion and force of every log, free-running."""
    motion = predict_motion(members.drive, logs)
    pairs = zip(motion, predict_force(members.force, motion), strict=True)
    return [SimpleNamespace(motion=each, force=force) for each, force in pairs]


def mirrored(force):
    return np.asarray(force) * [1, -1]


def motion(rows, seed=0):
    """Of a smooth random kind."""
    random = np.random.default_rng(seed)
    phase = random.uniform(0, 6, 3)
    time = np.arange(rows) * TICK_S
    rates = np.array([4.0, 7.0, 11.0])
    angle = np.sin(np.outer(time, rates) + phase) @ [0.6, 0.4, 0.2]
    velocity = np.cos(np.outer(time, rates) + phase) @ (rates * [0.6, 0.4, 0.2])
    return Motion(jnp.asarray(angle, jnp.float32), jnp.asarray(velocity, jnp.float32))


def valid_rows(record, begin, end):
    return jax.tree.map(lambda x: x[begin:end], record)


def rows_of_ticks(motion, ticks):
    """Of a batch ``(batch, ticks)``."""
    return jax.tree.map(lambda x: x[:, ticks], motion)


def rows_of_first(log):
    """The motion that a log begins with."""
    return Motion(jnp.asarray(log.reading.angle[0]), jnp.asarray(log.reading.velocity[0]))


def forces_of(net, reading):
    """What a network says of a measured motion from its second row on."""
    motion = Motion(jnp.asarray(reading.angle), jnp.asarray(reading.velocity))
    return jax.jit(forces)(net, motion)
