"""Running normalisation: inputs of a network and values of a critic, in units of their own mean and deviation.

The statistics are leaves of the network and saved with its weights, but no optimiser changes them: no gradient reaches
them. Merged as in Chan, Golub and LeVeque 1979.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LEAST_DEVIATION = 0.1
"""Least divisor, so that a small change of a number that hardly varied in training stays small."""


class Normalisation(eqx.Module):
    """(x - mean) / deviation, number by number; nothing is changed before the first `updated`."""

    mean: Float[Array, "*stack numbers"]
    std: Float[Array, "*stack numbers"]
    """Standard deviation; it divides as `LEAST_DEVIATION` where it is less."""
    count: Float[Array, "*stack"]
    """Number of vectors that the statistics weigh as."""

    @classmethod
    def create(cls, numbers: int) -> "Normalisation":
        """The identity."""
        return cls(jnp.zeros(numbers), jnp.ones(numbers), jnp.zeros(()))

    def __call__(self, x: Float[Array, "*batch numbers"]) -> Float[Array, "*batch numbers"]:
        """The numbers with a mean of about 0 and a deviation of about 1."""
        mean, scale = self._frozen()
        return (x - mean) / scale

    def inverse(self, x: Float[Array, "*batch numbers"]) -> Float[Array, "*batch numbers"]:
        """The inverse function."""
        mean, scale = self._frozen()
        return mean + scale * x

    def updated(self, x: Float[Array, "*batch numbers"], most: float | int = jnp.inf) -> "Normalisation":
        """The normalisation with a batch of vectors counted, too; earlier ones weigh as at most `most` vectors."""
        rows = x.reshape(-1, x.shape[-1])
        new, old = float(len(rows)), jnp.minimum(self.count, most)
        total = old + new
        step = rows.mean(axis=0) - self.mean
        variance = (old * self.std**2 + new * rows.var(axis=0)) / total + old * new * (step / total) ** 2
        return Normalisation(self.mean + step * new / total, jnp.sqrt(variance), total)

    @property
    def scale(self) -> Float[Array, "*stack numbers"]:
        """Divisor of the deviations from the mean."""
        return jnp.maximum(self.std, LEAST_DEVIATION)

    def _frozen(self) -> tuple[Array, Array]:
        return jax.lax.stop_gradient(self.mean), jax.lax.stop_gradient(self.scale)
