"""Families of fins for the page's tests, whose tables are random numbers."""

import numpy as np

from softfin.control.controller import LoadedController
from softfin.control.family import Family
from softfin.control.gait import GaitStep
from softfin.core.action_clock import ActionClock
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.gait import GaitTable
from softfin.gaits.reachable import Cell
from tests.gaits import known


def gaits_at(clock: ActionClock) -> LoadedController:
    """A gait controller with another clock."""
    actions = np.random.default_rng(2).uniform(-1, 1, (3, 4, clock.window_actions, 2))
    table = GaitTable(known.TABLE.low, known.TABLE.high, actions.astype(np.float32))
    box = Cell(low=tuple(table.low.tolist()), high=tuple(table.high.tolist()))
    return LoadedController(
        GaitStep(table), PAPER_LIMITS, (box,), known.KNOWN.reachable, clock=clock
    )


def random_family(controller: LoadedController) -> Family:
    """A family of three coefficients whose fins beat anyhow, about the references."""
    clock = controller.clock
    assert controller.reachable is not None
    numbers = np.random.default_rng(4)
    box = controller.reachable.bounding_box()
    axes = (np.linspace(*ends, 4) for ends in zip(box.low, box.high, strict=True))
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    actions = clock.window_actions
    spread = np.array([1.0, 1.0, 0.5, 0.3, 1.0, 0.4, 2.0])
    share = np.array(clock.action_ticks(actions)) / clock.window_ticks
    nominal = numbers.normal(size=(4, 4, actions, 7)) * spread
    nominal[..., :2] += (nodes - np.einsum("a,xyaf->xyf", share, nominal)[..., :2])[:, :, None]
    features = numbers.normal(size=(3, 3, actions, 3, 7)) * spread / 10
    tables = Family(
        low=np.array(box.low),
        high=np.array(box.high),
        nominal=nominal,
        nominal_noise=0.01 * numbers.uniform(0, 1, (4, 4, 7)),
        friction=numbers.uniform(-1, 1, (4, 4, actions, 2)),
        force=np.einsum("a,xyacf->xycf", share, features[..., :2]),
        features=features,
        force_noise=np.array([0.01, 0.02]),
        feature_noise=0.01 * spread,
        feature_spread=spread,
    )
    # Families are stored in half precision.
    return Family(*(table.astype(np.float16).astype(np.float32) for table in tables))
