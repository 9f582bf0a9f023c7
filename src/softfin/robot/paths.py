"""Paths to follow: the target state of a robot as a function of time."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from softfin.robot.rotation import (
    Quaternion,
    SixVector,
    Vector,
    from_euler,
    inverse_rotation,
    matrix,
    multiply,
    six,
    to_vector,
)

CurvePoint: TypeAlias = tuple[float | int, float | int, float | int]


class PathPoint(NamedTuple):
    """Target state of the robot, with velocities and accelerations in world axes."""

    position: Vector
    """[m]"""
    attitude: Quaternion
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
    return six(target.velocity @ axes, target.turn @ axes)


def path_error(target: PathPoint, position: Vector, attitude: Quaternion) -> SixVector:
    """Return the position relative to the path [m] and the rotation vector from the path's attitude
    [rad], both in the path's axes."""
    moved = (position - target.position) @ matrix(target.attitude)
    return six(moved, to_vector(multiply(inverse_rotation(target.attitude), attitude)))


Path: TypeAlias = Callable[[float], PathPoint]

DIFFERENCE_STEP_S = 0.01
"""Step of the finite differences for a path's velocity and acceleration [s]."""

STARTING_S = 10.0
"""Time over which the speed along a path rises from 0 [s]."""


def hold_place(position: CurvePoint = (0.0, 0.0, 0.0), yaw: float | int = 0.0) -> Path:
    """Return a path that stays at one position, upright."""
    still = PathPoint(np.asarray(position, float), from_euler(0.0, 0.0, yaw), *np.zeros((4, 3)))
    return lambda time: still


def along(curve: Callable[[float], Vector], speed_m_s: float | int) -> Path:
    """Return a path along a closed curve, ``curve(0 .. 1)``, at a mean speed, with a slow start and
    the nose in the direction of travel."""
    points = np.array([curve(u) for u in np.linspace(0, 1, 2001)])
    # Fraction of the curve per second: speed divided by length, where the length is that of a
    # polygon.
    rate = speed_m_s / float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    def part(time: float) -> float:
        if time < STARTING_S:
            # Smooth start: the integral of a smoothstep, which rises from 0 to 1.
            u = max(time, 0.0) / STARTING_S
            return rate * STARTING_S * (u**3 - u**4 / 2)
        # The slow start covers half the distance that full speed would.
        return rate * (time - STARTING_S / 2)

    def place(time: float) -> Vector:
        return np.asarray(curve(part(time)), float)

    def heading(time: float) -> float:
        at = part(time)
        ahead = np.asarray(curve(at + 1e-4), float) - np.asarray(curve(at - 1e-4), float)
        return float(np.arctan2(ahead[1], ahead[0]))

    def target(time: float) -> PathPoint:
        times = (time - DIFFERENCE_STEP_S, time, time + DIFFERENCE_STEP_S)
        before, now, after = map(place, times)
        # Jumps of 2 pi would become spikes in the angular velocity.
        yaws = np.unwrap([heading(at) for at in times])
        turn = np.zeros(3)
        turning = np.zeros(3)
        # Central differences: (f(t + h) - f(t - h)) / 2h, and (f(t + h) - 2 f(t) + f(t - h)) / h^2.
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


def lemniscate(speed_m_s: float | int) -> Path:
    """Return a figure-of-eight path (lemniscate of Gerono) in the horizontal plane, 2 m long and 1
    m wide."""

    def curve(u: float) -> Vector:
        s = 2 * np.pi * u
        return np.array([np.sin(s), 0.5 * np.sin(2 * s), 0.0])

    return along(curve, speed_m_s)


def lissajous(speed_m_s: float | int) -> Path:
    """Return a three-dimensional Lissajous path, 2 m by 1 m by 0.5 m, with frequencies 1, 2 and
    1."""

    def curve(u: float) -> Vector:
        s = 2 * np.pi * u
        return np.array([np.sin(s), 0.5 * np.sin(2 * s), 0.25 * (np.cos(s) - 1)])

    return along(curve, speed_m_s)
