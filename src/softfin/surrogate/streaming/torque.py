"""The torque on the fin about the shaft: a linear function of the odd quantities in the state of a
force network. The power delivered to the fin is this torque times the velocity of the shaft.

The coefficients are identified by least squares after the force networks have been trained, so the
forces do not depend on the torque.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.compilation import jit
from softfin.core.log_channels import LOAD_CHANNELS
from softfin.core.power import mechanical_power, tick_velocity
from softfin.core.quantities import Log
from softfin.core.window import window_means
from softfin.surrogate.streaming.ensemble import (
    PowerInterval,
    calibrate,
    split_first_row,
)
from softfin.surrogate.streaming.nets import ForceNet, ForceState
from softfin.surrogate.streaming.segments import Motion

TORQUE = LOAD_CHANNELS[-1]

IDENTIFICATION_LOGS = 20
"""Maximum number of training logs from which the coefficients are identified."""

EVERY = 7
"""Interval between the samples used from these logs [ticks]."""

MotionLogs = Sequence[tuple[Motion, Log]]
"""Logs that contain the torque, with their predicted motions ``(members, rows)``."""


def with_torque(motion: Sequence[Motion], logs: Sequence[Log]) -> MotionLogs:
    """Return the logs that contain the torque in every row, with their motions."""
    pairs = zip(motion, logs, strict=True)
    return [pair for pair in pairs if np.isfinite(pair[1].channels.get(TORQUE, np.nan)).all()]


def fit_torque(
    nets: ForceNet, trained: MotionLogs, held_out: MotionLogs, burn_in: int
) -> tuple[ForceNet, PowerInterval | None]:
    """Return the networks with the torque, and the interval of the mean power; without torque if
    there are no logs of it."""
    if not (trained and held_out):
        # A refit starts from coefficients for the previous weights.
        return replace_torque(nets, None), None
    nets = identify_torque(nets, trained, burn_in)
    floor_w, entries = calibrate(*power_means(nets, held_out, burn_in), len(held_out))
    return nets, PowerInterval(floor_w=floor_w, **entries)


def identify_torque(nets: ForceNet, recorded: MotionLogs, burn_in: int) -> ForceNet:
    """Return the networks with the coefficients of the torque, without the first `burn_in` ticks of
    each log."""
    motion, logs = zip(*recorded[:IDENTIFICATION_LOGS], strict=True)
    part = slice(burn_in, None, EVERY)
    features = np.concatenate([_features(nets, each)[:, part] for each in motion], axis=1)
    torque = np.concatenate([np.asarray(log.channels[TORQUE])[1:][part] for log in logs])
    coefficients = []
    for member in features.astype(np.float64):
        # The last coefficient is the offset of the sensor, which is not part of the torque.
        rows = np.column_stack([member, np.ones(len(member))])
        coefficients.append(np.linalg.lstsq(rows, torque)[0][:-1])
    return replace_torque(nets, jnp.asarray(np.array(coefficients), jnp.float32))


def replace_torque(
    nets: ForceNet, coefficients: Float[Array, "members features"] | None
) -> ForceNet:
    """Return networks with these coefficients of the torque."""
    replaced: ForceNet = eqx.tree_at(
        lambda net: net.torque, nets, coefficients, is_leaf=lambda leaf: leaf is None
    )
    return replaced


def predict_power(nets: ForceNet, motion: Motion) -> Float[np.ndarray, "members ticks"]:
    """Predict the power delivered to the fin in each row of a motion ``(members, rows)`` except the
    first [W]."""
    torque = np.einsum("mtf,mf->mt", _features(nets, motion), np.asarray(nets.torque))
    return np.asarray(torque * tick_velocity(np.asarray(motion.velocity))[:, 1:])


def power_means(
    nets: ForceNet, recorded: MotionLogs, burn_in: int
) -> tuple[Float[np.ndarray, "members windows 1"], Float[np.ndarray, "windows 1"]]:
    """Return the predicted and the measured mean power over all windows, without the first
    `burn_in` ticks of each log [W]."""
    means = []
    measured = []
    for motion, log in recorded:
        means.append(window_means(predict_power(nets, motion)[:, burn_in:, None]))
        torque = np.asarray(log.channels[TORQUE])[:, None]
        power = mechanical_power(torque, np.asarray(log.reading.velocity))
        measured.append(window_means(power[1 + burn_in :]))
    return np.concatenate(means, axis=1), np.concatenate(measured)


@jit("low")
def _features(nets: ForceNet, motion: Motion) -> Float[Array, "members ticks features"]:
    """Return the odd features after each row of a motion ``(members, rows)`` except the first."""

    def one(net: ForceNet, motion: Motion) -> Float[Array, "ticks features"]:
        before, after = split_first_row(motion)

        def step(state: ForceState, now: Motion) -> tuple[ForceState, Array]:
            state, _ = net.step(state, now)
            return state, state.odd_features()

        return jax.lax.scan(step, net.start(before), after)[1]

    features: Array = eqx.filter_vmap(one)(nets, motion)
    return features
