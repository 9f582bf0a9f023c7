"""Check of a robot: rank, singular values and reach of its fins, and stability of its body."""

from collections.abc import Iterable, Sequence

import numpy as np

from softfin.core.json_object import JsonObject
from softfin.robot.allocation import Allocator
from softfin.robot.body_config import GRAVITY_M_S2, BodyConfig
from softfin.robot.description import WRENCH_AXES, RobotConfig

WEAK = 1e-3
"""Fraction of the largest singular value below which singular values count as zero."""


def check_robot(robot: RobotConfig, max_thrust_n: Sequence[float]) -> JsonObject:
    """Return rank and singular values, the rank without each fin, and the reach and acceleration
    along every axis.

    `max_thrust_n` is the maximum mean force of each fin in every direction [N]. `problems` lists
    the reasons why the body, as described, cannot be controlled.
    """
    matrix = robot.matrix()
    count = len(robot.fins)
    allocator = Allocator(matrix, np.array(max_thrust_n, float))
    along = np.array([allocator.reach_along(axis) for axis in range(6)])
    inertia = robot.body.inertia().diagonal()
    without = {
        name: _rank(np.delete(matrix, [2 * fin, 2 * fin + 1], axis=1))
        for fin, name in enumerate(robot.fins)
    }
    return {
        "robot": robot.name,
        "fins": count,
        "rank": _rank(matrix),
        "singular_values": [round(float(value), 4) for value in np.linalg.svd(matrix)[1]],
        "rank_without": without if count > 1 else {},
        "max_thrust_n": dict(zip(robot.fins, max_thrust_n, strict=True)),
        "reach": _rounded(WRENCH_AXES, along),
        "acceleration": _rounded(WRENCH_AXES, along / inertia),
        "sinks_n": round(robot.body.mass_kg * GRAVITY_M_S2 - robot.body.upward_n, 3),
        "righting_nm_rad": round(robot.body.righting_nm_rad, 3),
        "swing_hz": _swing_frequencies(robot.body),
        "problems": _stability_problems(robot.body),
    }


def _rounded(names: Iterable[str], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, (round(float(value), 3) for value in values), strict=True))


def _swing_frequencies(body: BodyConfig) -> dict[str, float]:
    """Return the natural frequencies of roll and pitch about upright [Hz]; empty if the body is not
    self-righting.

    Drag is neglected. Sway and surge are free, because a centre of gravity off the origin couples
    them to roll and pitch.
    """
    if body.righting_nm_rad <= 0:
        return {}
    inertia = body.inertia()
    frequencies = {}
    for name, follows in (("roll", "sway"), ("pitch", "surge")):
        axes = [WRENCH_AXES.index(follows), WRENCH_AXES.index(name)]
        compliance = np.linalg.inv(inertia[np.ix_(axes, axes)])
        # omega^2 = k / m: righting stiffness times the compliance with both axes free.
        frequencies[name] = round(
            float(np.sqrt(body.righting_nm_rad * compliance[1, 1]) / (2 * np.pi)), 3
        )
    return frequencies


def _stability_problems(body: BodyConfig) -> list[str]:
    righting = body.righting_nm_rad
    if righting > 0:
        return []
    effect = (
        f"turn it away from upright with {-righting:.3g} N m/rad"
        if righting < 0
        else "do not right it"
    )
    return [
        f"body: unstable in roll and pitch: weight and buoyancy {effect}; put "
        "centre_of_buoyancy_m above centre_of_gravity_m (z is up), or control both axes"
    ]


def _rank(matrix: np.ndarray) -> int:
    values = np.linalg.svd(matrix)[1] if matrix.size else np.zeros(1)
    return int((values > WEAK * values[0]).sum()) if values[0] > 0 else 0
