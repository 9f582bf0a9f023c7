"""CMA-ES (Hansen 2016, arXiv:1604.00772) with random numbers of its own: its seed alone decides.

The library by itself seeds NumPy's generator of the whole process and draws from it, and obeys a file
``cma_signals.in`` where one lies in the working directory. Here it does neither.
"""

from typing import Any

import cma
import numpy as np
from jaxtyping import Float


def cma_es(start: Float[np.ndarray, "n"], step: float, random: np.random.Generator, **options: Any) -> Any:
    """A search from `start` with steps of that standard deviation: ``ask`` for points, ``tell`` their losses.

    Further options are those of ``cma.CMAOptions``, such as `popsize`, `bounds` and `maxiter`.
    """
    own = {"randn": lambda *shape: random.standard_normal(shape), "seed": np.nan}
    silent = {"verbose": -10}  # from -9 on it reads the file
    return cma.CMAEvolutionStrategy(start, step, {**options, **own, **silent})
