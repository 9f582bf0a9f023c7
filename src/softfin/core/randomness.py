"""One seed per run, split by name: the same seed and name produce the same numbers, whatever other
numbers the run draws.

By default, the CMA-ES library seeds NumPy's global generator, draws from it, and reads a file
``cma_signals.in`` in the working directory; `cma_es` prevents this.
"""

import zlib
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray


def named_key(seed: int, name: str) -> PRNGKeyArray:
    """Return the JAX key for a purpose, such as ``named_key(0, "collect/train/7")``."""
    # CRC-32 is the same in every process, unlike Python's hash of a string.
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))


def named_generator(seed: int, name: str) -> np.random.Generator:
    """Return the NumPy generator for a purpose; as in JAX, only the lowest 32 bits of the seed are
    used."""
    return np.random.default_rng([seed % 2**32, zlib.crc32(name.encode())])


def cma_es(
    start: Float[np.ndarray, "n"], step: float, random: np.random.Generator, **options: object
) -> Any:
    """Start CMA-ES (Hansen 2016, arXiv:1604.00772) at `start` with the given step size; ``ask`` it
    for points and ``tell`` it their losses.

    Other options are passed to ``cma.CMAOptions``, such as `popsize`, `bounds` and `maxiter`.
    """
    # Imported here because it is slow and rarely needed.
    import cma

    # With a NaN seed, the library does not touch NumPy's global generator; with a verbosity below
    # -9, it skips the signals file.
    own = {"randn": lambda *shape: random.standard_normal(shape), "seed": np.nan, "verbose": -10}
    return cma.CMAEvolutionStrategy(start, step, options | own)
