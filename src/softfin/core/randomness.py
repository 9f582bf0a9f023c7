"""One seed a run, split by name: the same seed and name give the same numbers, whatever else the run draws."""

import zlib

import jax
import numpy as np
from jaxtyping import PRNGKeyArray


def key_of(seed: int, name: str) -> PRNGKeyArray:
    """The JAX key of one purpose, say ``key_of(0, "collect/train/7")``."""
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))


def generator_of(seed: int, name: str) -> np.random.Generator:
    """The NumPy generator of one purpose; of the seed the last 32 bits count, as they do in JAX."""
    return np.random.default_rng([seed % 2**32, zlib.crc32(name.encode())])
