"""One seed a run, split by name: the same seed and name give the same numbers, whatever else the
run draws.

The library of CMA-ES by itself seeds NumPy's generator of the whole process and draws from it, and
obeys a file ``cma_signals.in`` where one lies in the working directory; `cma_es` does neither.
"""

import zlib
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray


def named_key(seed: int, name: str) -> PRNGKeyArray:
    """The JAX key of one purpose, say ``named_key(0, "collect/train/7")``."""
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))


def named_generator(seed: int, name: str) -> np.random.Generator:
    """The NumPy generator of one purpose; of the seed the last 32 bits count, as they do in JAX."""
    return np.random.default_rng([seed % 2**32, zlib.crc32(name.encode())])


def cma_es(
    start: Float[np.ndarray, "n"], step: float, random: np.random.Generator, **options: object
) -> Any:
    """CMA-ES (Hansen 2016, arXiv:1604.00772) from `start` with that step: ``ask`` for points,
    ``tell`` losses.

    Further options are those of ``cma.CMAOptions``, such as `popsize`, `bounds` and `maxiter`.
    """
    # Imported here: it takes a moment, and few search.
    import cma

    # From verbose -9 on it reads the file.
    own = {"randn": lambda *shape: random.standard_normal(shape), "seed": np.nan, "verbose": -10}
    return cma.CMAEvolutionStrategy(start, step, options | own)
