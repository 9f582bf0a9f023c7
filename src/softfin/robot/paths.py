"""Paths to follow: the target state of a robot as a function of time."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray
from softfin.robot.rotation import from_euler, inverse_rotation, matrix, multiply, to_vector

Vector = Float[AnyArray, "3"]
SixVector = Float[AnyArray, "6"]
CurvePoint: TypeAlias = tuple[float | int, float | int, float | int]


class PathPoint(NamedTuple):
    """Target state of the robot; velocities and accelerations in world axes."""

    position: Vector
    """[m]"""
    attitude: Float[AnyArray, "4"]
    """Unit quaternion from body to world axes."""
    velocity: Vector
    """[m/s]"""
    acceleration: Vector
    """[m/s2]"""
    turn: Vector
    """Angular velocity [rad/s]."""
    turning: Vector
    """Angular acceleration [rad/s2]."""


def path_twist(target: PathPoint) -> SixVector:
    """Return the twist of a body on the path, in its own axes [m/s, rad/s]."""
    axes = matrix(target.attitude)
    twist: SixVector = select_operations(axes).xp.concatenate(
        [target.velocity @ axes, target.turn @ axes]
    )
    return twist


def path_error(target: PathPoint, position: Vector, attitude: Float[AnyArray, "4"]) -> SixVector:
    """Return the position relative to the path, in the path's axes [m], and the rotation vector
    from its attitude [rad]."""
    moved = (position - target.position) @ matrix(target.attitude)
    error: SixVector = select_operations(position, attitude, *target).xp.concatenate(
        [moved, to_vector(multiply(inverse_rotation(target.attitude), attitude))]
    )
    return error


Path: TypeAlias = Callable[[float], PathPoint]

DIFFERENCE_STEP_S = 0.01
"""Step of the finite differences for a path's velocity and acceleration [s]."""

STARTING_S = 10.0
"""Time in which a path's speed grows from 0 [s]."""


def hold_place(position: CurvePoint = (0.0, 0.0, 0.0), yaw: float | int = 0.0) -> Path:
    """Hold a place, upright."""
    still = PathPoint(np.asarray(position, float), from_euler(0.0, 0.0, yaw), *np.zeros((4, 3)))
    return lambda time: still


def along(curve: Callable[[float], Vector], speed_m_s: float | int, length_m: float | int) -> Path:
    """Follow a closed curve, ``curve(0 .. 1)``, at a mean speed, with a slow start and the nose
    along the path."""

    def part(time: float) -> float:
        rate = speed_m_s / length_m
        if time < STARTING_S:
            # A smooth start: the integral of a smoothstep.
            u = max(time, 0.0) / STARTING_S
            return rate * STARTING_S * (u**3 - u**4 / 2)
        return rate * (time - STARTING_S / 2)

    def place(time: float) -> Vector:
        return np.asarray(curve(part(time)), float)

    def heading(time: float) -> float:
        at = part(time)
        ahead = np.asarray(curve(at + 1e-4), float) - np.asarray(curve(at - 1e-4), float)
        return float(np.arctan2(ahead[1], ahead[0]))

    def target(time: float) -> PathPoint:
        before, now, after = (place(time + k * DIFFERENCE_STEP_S) for k in (-1, 0, 1))
        yaws = np.unwrap([heading(time + k * DIFFERENCE_STEP_S) for k in (-1, 0, 1)])
        turn = np.zeros(3)
        turning = np.zeros(3)
        turn[2] = (yaws[2] - yaws[0]) / (2 * DIFFERENCE_STEP_S)
        turning[2] = (yaws[2] - 2 * yaws[1] + yaws[0]) / DIFFERENCE_STEP_S**2
        return PathPoint(
            now,
            from_euler(0.0, 0.0, float(yaws[1])),
            (after - before) / (2 * DIFFERENCE_STEP_S),
            (after - 2 * now + before) / DIFFERENCE_STEP_S**2,
            turn,
            turning,
        )

    return target


def _length(curve: Callable[[float], Vector]) -> float:
    points = np.array([curve(u) for u in np.linspace(0, 1, 2001)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def lemniscate(
    speed_m_s: float | int, length_m: float | int = 2.0, width_m: float | int = 1.0
) -> Path:
    """Follow a figure of eight in the horizontal plane (Gerono's lemniscate) with the given length
    and width."""

    def curve(u: float) -> Vector:
        s = 2 * np.pi * u
        return np.array([length_m / 2 * np.sin(s), width_m / 2 * np.sin(2 * s), 0.0])

    return along(curve, speed_m_s, _length(curve))


def lissajous(speed_m_s: float | int, size_m: CurvePoint = (2.0, 1.0, 0.5)) -> Path:
    """Follow a three-dimensional Lissajous curve of the given size with frequencies 1, 2 and 1."""

    def curve(u: float) -> Vector:
        s = 2 * np.pi * u
        return np.array(
            [
                size_m[0] / 2 * np.sin(s),
                size_m[1] / 2 * np.sin(2 * s),
                size_m[2] / 2 * (np.cos(s) - 1),
            ]
        )

    return along(curve, speed_m_s, _length(curve))
