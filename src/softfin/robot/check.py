"""Rank, singular values and reach of a robot's fins."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from softfin.robot.allocation import Allocator
from softfin.robot.body_config import GRAVITY_M_S2
from softfin.robot.description import WRENCH_AXES, RobotConfig
from softfin.robot.dynamics import Dynamics
from softfin.robot.fin_driver import FinGaits

WEAK = 1e-3
"""A singular value below this part of the greatest counts as none."""


def check_robot(robot: RobotConfig, gaits: Sequence[FinGaits]) -> dict[str, Any]:
    """Return rank and singular values, with all fins and without each of them, reach and acceleration of every axis."""
    matrix, count = robot.matrix(), len(robot.fins)
    reach = np.array([each.reach for each in gaits])
    allocator = Allocator(matrix, reach)
    along = np.array([allocator.reach_along(axis) for axis in range(6)])
    inertia = np.asarray(Dynamics.of(robot.body).inertia).diagonal()
    without = {name: _rank(np.delete(matrix, [2 * fin, 2 * fin + 1], axis=1)) for fin, name in enumerate(robot.fins)}
    return {
        "robot": robot.name,
        "fins": count,
        "rank": _rank(matrix),
        "singular_values": [round(float(value), 4) for value in np.linalg.svd(matrix)[1]],
        "rank_without": without if count > 1 else {},
        "fin_reach_n": dict(zip(robot.fins, (round(float(r), 3) for r in reach), strict=True)),
        "reach": {name: round(most, 3) for name, most in zip(WRENCH_AXES, along, strict=True)},
        "acceleration": {name: round(float(a), 3) for name, a in zip(WRENCH_AXES, along / inertia, strict=True)},
        "sinks_n": round(robot.body.mass_kg * GRAVITY_M_S2 - robot.body.upward_n, 3),
    }


def _rank(matrix: np.ndarray) -> int:
    values = np.linalg.svd(matrix)[1] if matrix.size else np.zeros(1)
    return int((values > WEAK * values[0]).sum()) if values[0] > 0 else 0
