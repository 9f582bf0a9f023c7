"""Check of a robot: rank, singular values and reach of its fins."""

from collections.abc import Sequence

import numpy as np

from softfin.core.json_object import JsonObject
from softfin.robot.allocation import Allocator
from softfin.robot.description import WRENCH_AXES, RobotConfig

WEAK = 1e-3
"""Fraction of the largest singular value below which singular values are treated as zero."""


def check_robot(robot: RobotConfig, max_thrust_n: Sequence[float]) -> JsonObject:
    """Return rank and singular values, the rank without each fin, and the reach along every axis.

    `max_thrust_n` is the maximum mean force of each fin in every direction [N].
    """
    matrix = robot.matrix()
    count = len(robot.fins)
    allocator = Allocator(matrix, np.array(max_thrust_n, float))
    reach = {
        name: round(float(allocator.reach_along(axis)), 3) for axis, name in enumerate(WRENCH_AXES)
    }
    without = {}
    for fin, name in enumerate(robot.fins if count > 1 else ()):
        others = np.delete(matrix, [2 * fin, 2 * fin + 1], axis=1)
        without[name] = int(np.linalg.matrix_rank(others, rtol=WEAK))
    return {
        "robot": robot.name,
        "fins": count,
        "rank": int(np.linalg.matrix_rank(matrix, rtol=WEAK)),
        "singular_values": [round(float(value), 4) for value in np.linalg.svd(matrix)[1]],
        "rank_without": without,
        "max_thrust_n": dict(zip(robot.fins, max_thrust_n, strict=True)),
        "reach": reach,
    }
