"""An ensemble's estimates of its own errors: an interval on the mean force, and how far a motion is from its data.

The interval is split conformal (Lei et al. 2018, J. Am. Stat. Assoc. 113:1094): errors on logs that no weight was
trained on, divided by what the members' disagreement expects of them, and their quantile. The same logs chose among the
ten sets of weights of each member, and windows of one log share its drift: so it is calibrated, not guaranteed. The
distance is Mahalanobis's in the memory of a net (Lee et al. 2018, NeurIPS), which depends on the last motion.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import AnyArray, Log
from softfin.core.window import window_means
from softfin.surrogate.streaming.member import single
from softfin.surrogate.streaming.nets import ForceNet, ForceState
from softfin.surrogate.streaming.segments import Motion

COVERAGE = 0.9
"""Share of the mean forces that an interval should hold."""

ENOUGH_LOGS = 10
"""Held-out logs below which an interval hardly covers what differs from log to log, such as the sensor's drift."""

RARE = 0.999
"""Share of the training data that is nearer than distance 1."""

LOGS, EVERY = 50, 7
"""Logs that the distance is measured from, and ticks between the moments that are taken from them."""


class Interval(Configuration):
    """Interval of the mean force over the evaluation window, on either axis.

    half width = factor * sqrt(spread^2 + floor^2), with the variance spread^2 over the members.
    """

    coverage: float = Field(gt=0, lt=1)
    """Share of the means that it should hold [-]."""
    factor: float = Field(gt=0)
    """Quantile of |error| / sqrt(spread^2 + floor^2) on the held-out logs [-]."""
    floor_n: float = Field(gt=0)
    """Root mean square error of the ensemble's mean there [N]: noise, drift, and what all members have wrong."""
    windows: int = Field(ge=1)
    """Means that it was calibrated with, those of both axes."""
    logs: int = Field(ge=1)
    """Logs that these means came from."""

    def half_width(self, means: Float[AnyArray, "members *shape"]) -> Float[AnyArray, "*shape"]:
        """Half width of the interval, from the members' own means [N]."""
        return self.factor * (means.var(axis=0) + self.floor_n**2) ** 0.5

    def caveat(self) -> str | None:
        """Why the interval is not to be relied on, in a sentence; None if it may be."""
        if self.logs >= ENOUGH_LOGS:
            return None
        return (
            f"intervals come from {self.logs} held-out log{'s' * (self.logs != 1)}; with less than {ENOUGH_LOGS} they "
            "hardly cover what differs from log to log, such as the sensor's drift"
        )


def calibrated(predicted: Sequence[Float[np.ndarray, "members rows 2"]], logs: Sequence[Log], burn_in: int) -> Interval:
    """Calibrate the interval on the members' predictions of held-out logs behind the first `burn_in` ticks."""
    means = np.concatenate([window_means(force[:, burn_in:]) for force in predicted], axis=1)
    measured = np.concatenate([window_means(np.asarray(log.reading.force)[burn_in:]) for log in logs])
    error = np.abs(means.mean(axis=0) - measured)
    floor_n = float(np.sqrt(np.mean(error**2)))
    ratio = error / (means.var(axis=0) + floor_n**2) ** 0.5
    # One more than there are, so that the next error is covered and not only these.
    level = min(1.0, COVERAGE * (1 + 1 / ratio.size))
    factor = float(np.quantile(ratio, level, method="inverted_cdf"))
    return Interval(coverage=COVERAGE, factor=factor, floor_n=floor_n, windows=ratio.size, logs=len(logs))


class Familiarity(eqx.Module):
    """Where the training data lie in the memory of the first member's force net."""

    mean: Float[Array, "remembered"]
    whitening: Float[Array, "remembered remembered"]
    """Inverse square root of the covariance, over the distance that only 1 of 1000 training moments exceeds."""

    def distance(self, memory: Float[Array, "remembered"]) -> Float[Array, ""]:
        """Out-of-distribution score: 1 where only one of a thousand moments of the training data is as far out."""
        return jnp.sqrt(jnp.sum(((memory - self.mean) @ self.whitening) ** 2))


def remembered(state: ForceState) -> Float[Array, "remembered"]:
    """Memory of a force net, in which the distance is measured."""
    return jnp.concatenate(jax.tree.leaves((state.memory, state.wake)))


def familiar(nets: ForceNet, motion: Sequence[Motion], burn_in: int) -> Familiarity:
    """Where the training logs lie, from their predicted motion ``(members, rows)`` from the row `burn_in` + 1 on."""
    some = [each for each in motion if each.angle.shape[1] > burn_in + 1][:LOGS]
    each = [np.asarray(_memories(single(nets), single(motion)))[burn_in::EVERY] for motion in some]
    memory = np.concatenate(each).astype(np.float64)
    mean = memory.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(memory, rowvar=False))
    # A direction in which nothing moves would make rounding errors look far.
    whitening = vectors / np.sqrt(np.maximum(values, 1e-6 * values.max()))
    far = np.quantile(np.linalg.norm((memory - mean) @ whitening, axis=1), RARE)
    return Familiarity(jnp.asarray(mean, jnp.float32), jnp.asarray(whitening / far, jnp.float32))


@eqx.filter_jit
def _memories(net: ForceNet, motion: Motion) -> Float[Array, "ticks remembered"]:
    """Memory behind every row of a motion ``(rows,)`` but the first."""

    def step(state: ForceState, now: Motion) -> tuple[ForceState, Array]:
        state, _ = net.step(state, now)
        return state, remembered(state)

    return jax.lax.scan(step, net.start(Motion(*(x[0] for x in motion))), Motion(*(x[1:] for x in motion)))[1]
