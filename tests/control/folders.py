"""Controllers' folders of every kind, small, with loud random policies."""

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Float

from softfin.learning.controllers import save_policies
from softfin.learning.layers import Normalisation
from softfin.learning.train import TrainedPolicies
from tests.control.test_controllers import GRID_RUN, SINGLE_RUN
from tests.gaits.known import KNOWN, save_known

KINDS = ("single", "grid", "gaits")


def folder_option(kind: str, folder: Path) -> Path:
    """Write one and say where."""
    out = folder / kind
    if kind == "gaits":
        return save_known(out)
    save_policies(out, trained(kind), {"seed": 5}, {})
    return out


def trained(kind: str) -> TrainedPolicies:
    """As if trained, with statistics that are not the identity."""
    run = SINGLE_RUN if kind == "single" else GRID_RUN._replace(reachable=KNOWN.reachable)
    numbers = np.random.default_rng(3)
    shape = run.policies.normalisation.mean.shape

    def some(low: float | int, high: float | int) -> Float[Array, "cells numbers"]:
        return jax.numpy.asarray(numbers.uniform(low, high, shape), jax.numpy.float32)

    statistics = Normalisation(some(-1, 1), some(0, 2), jax.numpy.ones(shape[:-1]))
    return run._replace(
        policies=jax.vmap(lambda p, n: p.with_normalisation(n))(run.policies, statistics)
    )
