"""The fins of a robot whose body moves: each has a controller of its own and beats in a tank."""

import math
from collections.abc import Sequence
from itertools import cycle

import jax
import jax.numpy as jnp
import numpy as np

from softfin.control.controller import LoadedController, Measured
from softfin.core.plant import rest_command
from softfin.core.quantities import Command
from softfin.robot.description import RobotConfig
from softfin.tank import Tank
from softfin.tank.fin import Mount

MOVING = 0.85
"""Fraction of an action within which a fin turns to a new direction [-]."""

SMALL_TURN_RAD = 0.1
"""Turn up to which a stroke keeps the velocity of its gait [rad]."""


class TurningGaits:
    """Gaits that push forward, turned into the direction of each reference.

    Still water is the same in all directions, so a fin on a shaft without limits needs gaits for
    one direction only. A table of gaits for all directions would have a seam, where the angle jumps
    by a full turn.
    """

    def __init__(self, gaits: LoadedController) -> None:
        self._gaits = gaits
        self._memory = gaits.init()
        self._direction_rad = 0.0
        # Gaits for (force, 0).
        self._weakest_n = min(cell.low[0] for cell in gaits.cells)
        self._strongest_n = max(cell.high[0] for cell in gaits.cells)

    def act(self, measured: Measured, reference: np.ndarray) -> Command:
        """Return the next command for a reference force (x, y) in the fin's axes [N]."""
        x, y = reference.tolist()
        # At angle a the thrust points along (cos a, -sin a); the fin turns there the shorter way.
        turn = math.remainder(math.atan2(-y, x) - self._direction_rad, 2 * math.pi)
        self._direction_rad += turn
        # Bracing keeps the forces of living fins above the weakest one.
        force = min(max(math.hypot(x, y), self._weakest_n), self._strongest_n)
        turned = measured._replace(angle=measured.angle - self._direction_rad)
        self._memory, command = self._gaits.act(self._memory, turned, (force, 0.0))
        angle = float(command.angle) + self._direction_rad
        # Fast enough to arrive within the action.
        needed = abs(angle - measured.angle) * self._gaits.clock.rate_hz / MOVING
        velocity = float(command.velocity)
        if abs(turn) > SMALL_TURN_RAD:
            velocity = min(max(velocity, needed), self._gaits.limits.velocity_max)
        return Command(angle, velocity)


class TankFins:
    """Fins that start one after the other, as separate processes do."""

    def __init__(
        self,
        robot: RobotConfig,
        controller: LoadedController,
        tank: Tank,
        start_ticks: Sequence[int],
    ) -> None:
        """`start_ticks` are the times at which the fins' controllers start [10 ms]."""
        self._mounts = list(robot.fins.values())
        self._matrix = robot.matrix()
        self._controllers = [TurningGaits(controller) for _ in self._mounts]
        self._next = list(start_ticks)
        self._durations = [cycle(controller.clock.ticks) for _ in self._mounts]
        rest = rest_command(tank.limits)
        self._commands = np.tile(np.array(rest, np.float32), (len(self._mounts), 1))
        self._angles = np.full(len(self._mounts), tank.limits.rest_angle)
        self._forces: list[np.ndarray] = []
        self._states = jax.vmap(tank.init)(jax.random.split(jax.random.key(0), len(self._mounts)))
        self._tick = jax.jit(jax.vmap(tank.tick))
        self._now = 0

    def tick(
        self, references: np.ndarray, twist: np.ndarray, acceleration: np.ndarray
    ) -> np.ndarray:
        """Advance by one tick of 10 ms; return the wrench of the fins in body axes [N, N m].

        `references` are the fins' reference forces [N]; `twist` and `acceleration` describe the
        motion of the body through the water.
        """
        for fin in range(len(self._mounts)):
            if self._now == self._next[fin]:
                self._act(fin, references[fin])
        commands = Command(*jnp.asarray(self._commands).T)
        mounts = self._mount_motion(twist, acceleration)
        self._states, readings, loads = self._tick(self._states, commands, mounts)
        self._angles = np.asarray(readings.angle, float)
        self._forces.append(np.asarray(readings.force, float))
        self._now += 1
        wrench = self._matrix @ np.asarray(loads.force, float).ravel()
        for mount, torque in zip(self._mounts, np.asarray(loads.torque, float), strict=True):
            wrench[3:] += torque * np.array(mount.shaft_axis)
        return wrench

    def _act(self, fin: int, reference: np.ndarray) -> None:
        duration = next(self._durations[fin])
        recent = [forces[fin] for forces in self._forces[-duration:]]
        force = np.mean(recent, axis=0) if recent else np.zeros(2)
        measured = Measured(float(self._angles[fin]), force)
        self._commands[fin] = self._controllers[fin].act(measured, reference)
        self._next[fin] += duration

    def _mount_motion(self, twist: np.ndarray, acceleration: np.ndarray) -> Mount:
        """Return the motion of each shaft through the water, in the fins' axes."""
        turn = twist[3:]
        # Acceleration of the origin in an inertial frame: dv/dt + omega x v.
        origin = acceleration[:3] + np.cross(turn, twist[:3])
        rows = []
        for mount in self._mounts:
            place = np.array(mount.position_m)
            around = np.cross(turn, place)
            velocity = twist[:3] + around
            change = origin + np.cross(acceleration[3:], place) + np.cross(turn, around)
            axes = mount.axes()
            rows.append((velocity @ axes, change @ axes, turn @ np.array(mount.shaft_axis)))
        return Mount(
            *(jnp.asarray(np.array(part), jnp.float32) for part in zip(*rows, strict=True))
        )
