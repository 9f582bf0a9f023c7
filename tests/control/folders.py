"""Controllers' folders of every kind, small, with loud random policies."""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from softfin.control.grid import SwitchingConfig
from softfin.control.store import save_gaits
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.force_map import MapConfig
from softfin.learning.configuration import GRID, SINGLE, TrainConfig
from softfin.learning.controllers import save_controller
from softfin.learning.layers import Normalisation
from softfin.learning.policy import Policy
from softfin.learning.run import TrainingResult
from tests.control.test_controllers import SIZE, untrained
from tests.gaits.test_map_store import KNOWN

KINDS = ("single", "phased", "grid", "cold", "gaits")
"""Phased and grid: with the phase observed, and gaits in the policies; cold: a grid without any of
it."""


def folder_option(kind: str, folder: Path) -> Path:
    """Write one and say where."""
    out = folder / kind
    if kind == "gaits":
        save_gaits(out, KNOWN, MapConfig(), PAPER_LIMITS, {"plant": "mine"})
    else:
        save_controller(out, trained(kind), 5, {"seed": 5})
    return out


def trained(kind: str) -> TrainingResult:
    """As if trained."""
    if kind == "single":
        return _normalised(untrained(SINGLE))
    if kind == "phased":
        return _phased(SINGLE)
    if kind == "cold":
        switching = SwitchingConfig(replay=False, fade_actions=0, margin_n=0)
        return _normalised(untrained(GRID.model_copy(update={"switching": switching})))
    run = _phased(GRID)
    return run._replace(reachable=KNOWN.reachable)


def _phased(config: TrainConfig) -> TrainingResult:
    task = config.task.model_copy(update={"phase": True, "past_actions": 2})
    run = untrained(config.model_copy(update={"task": task}))
    keys = jax.random.split(jax.random.key(1), run.policies.log_std.shape[:2])
    table = KNOWN.gaits.table
    unit = task.force_scale_n
    gaits = table._replace(low=table.low / unit, high=table.high / unit)
    policies = jax.vmap(
        jax.vmap(lambda key: Policy.create(key, SIZE, task.observations, gaits=gaits))
    )(keys)
    loud = jax.tree.map(lambda x: 3 * x, policies)
    return _normalised(
        run._replace(policies=eqx.tree_at(lambda policy: policy.gaits, loud, policies.gaits))
    )


def _normalised(run: TrainingResult) -> TrainingResult:
    """With statistics that are not the identity."""
    numbers = np.random.default_rng(3)
    shape = run.policies.normalisation.mean.shape

    def some(low: float | int, high: float | int) -> Float[Array, "seeds cells numbers"]:
        return jax.numpy.asarray(numbers.uniform(low, high, shape), jax.numpy.float32)

    statistics = Normalisation(some(-1, 1), some(0, 2), jax.numpy.ones(shape[:-1]))
    return run._replace(
        policies=jax.vmap(jax.vmap(lambda p, n: p.with_normalisation(n)))(run.policies, statistics)
    )
