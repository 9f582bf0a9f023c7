"""A wrench asked for becomes commands for all fins, action by action: allocation, bracing, phases,
gaits. NumPy alone.

driver = WrenchDriver(robot, gaits)
state = driver.init()
state, orders = driver.act(state, wrench)     # 3 times a second; orders.commands go to the fins
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from softfin.core.errors import RunError
from softfin.core.quantities import Command
from softfin.robot.allocation import Allocator, FinForces, SixVector
from softfin.robot.bracing import BracedAllocation
from softfin.robot.description import WRENCH_AXES, RobotConfig
from softfin.robot.dynamics import Dynamics
from softfin.robot.fin_driver import REST, DriverState, FinGaits, fin_command, stroke
from softfin.robot.phases import Phases, choose_phases, phase_delay, stroke_side, wrench_ripple

STILL = np.zeros(6)
"""Twist of a body that does not move."""

STARTING = 2
"""First actions, in which the fins' phases are free."""


class FinOrders(NamedTuple):
    """Orders to the fins for one action, and the wrench that they make."""

    commands: tuple[Command, ...]
    """For each fin [rad, rad/s]."""
    delays: tuple[int, ...]
    """Ticks of 10 ms into the action at which each fin gets its command; until then it keeps the
    one before."""
    forces: FinForces
    """Mean force of each fin in its own axes [N]."""
    wrench: SixVector
    """Wrench that they make in still water, in body axes [N, N m]."""
    given_up: Bool[np.ndarray, "6"]
    """Axes in which the wrench asked for is beyond the fins."""

    def told(self, wrench: SixVector) -> str:
        """Say in words what was given up of a wrench that was asked for; empty where nothing
        was."""
        if not self.given_up.any():
            return ""
        units = ("N",) * 3 + ("N m",) * 3
        parts = [
            f"{WRENCH_AXES[i]} {self.wrench[i]:.2f} of {wrench[i]:.2f} {units[i]}"
            for i in np.flatnonzero(self.given_up)
        ]
        return "beyond the fins' reach: " + ", ".join(parts)


class WrenchDriverState(NamedTuple):
    """State of the driver between actions."""

    forces: FinForces
    """Forces of the last action [N]."""
    brace: FinForces
    """Bracing of the last action: forces that cancel one another [N]."""
    action: int
    """Actions so far."""
    phases: Phases
    """Phase of each fin's strokes, 0 to 5."""
    fins: tuple[DriverState, ...]


class WrenchDriver:
    """Turns wrenches into commands for the fins of one robot; with `phases` the fins keep these."""

    def __init__(
        self, robot: RobotConfig, gaits: Sequence[FinGaits], phases: Phases | None = None
    ) -> None:
        self.robot = robot
        self.gaits = tuple(gaits)
        self._phases = phases
        self._allocation = BracedAllocation(robot, [each.reach for each in gaits])
        self._mounts = robot.mounts()
        self._inverse = np.asarray(Dynamics.of(robot.body).inverse)

    @property
    def allocator(self) -> Allocator:
        """The allocation, with the reaches of the fins that are alive."""
        return self._allocation.allocator

    @property
    def dead(self) -> tuple[int, ...]:
        """Fins that were declared dead, by their numbers."""
        return self._allocation.dead

    def init(self) -> WrenchDriverState:
        """Return the state of fins at rest at angle 0."""
        count = len(self.gaits)
        none = np.zeros((count, 2))
        return WrenchDriverState(none, none, 0, np.zeros(count, int), (REST,) * count)

    def declare_dead(self, fin: int) -> None:
        """Ask nothing more of a fin; the others make what they can."""
        self._allocation.declare_dead(fin)

    def act(
        self, state: WrenchDriverState, wrench: SixVector, twist: SixVector = STILL
    ) -> tuple[WrenchDriverState, FinOrders]:
        """Take one action of 1/3 s for a mean wrench in body axes [N, N m].

        `twist` is that with which the body is going to move through the water, as far as it is
        known [m/s, rad/s]: its fins then make up for the force that they lose by it.

        Raises:
            RunError: the wrench is not of finite numbers; the state is as it was.
        """
        wrench = np.asarray(wrench, float)
        if not np.isfinite(wrench).all():
            raise RunError(
                f"wrench {wrench.tolist()}: must be six finite numbers, 3 forces [N] and 3 moments "
                "[N m]"
            )
        (forces, together, given_up), brace = self._allocation.share(
            wrench, state.forces, state.brace
        )
        alive = [fin for fin in range(len(self.gaits)) if fin not in self.dead]
        phases = self._choose_phases(state, forces, alive)
        velocities = self._mounts.velocities(twist)
        fins = []
        commands = []
        for fin, gaits in enumerate(self.gaits):
            if fin in self.dead:
                fins.append(state.fins[fin])
                commands.append(fin_command(state.fins[fin].target, gaits.limits.velocity_min))
                continue
            side = stroke_side(int(phases[fin]), state.action)
            force = forces[fin] + gaits.lost(forces[fin], velocities[fin])
            moved, command = stroke(gaits, state.fins[fin], force, side)
            fins.append(moved)
            commands.append(command)
        after = WrenchDriverState(forces, brace, state.action + 1, phases, tuple(fins))
        delays = tuple(phase_delay(int(phase)) for phase in phases)
        return after, FinOrders(tuple(commands), delays, forces, together, given_up)

    def _choose_phases(
        self, state: WrenchDriverState, forces: FinForces, alive: list[int]
    ) -> Phases:
        if self._phases is not None or not alive:
            return state.phases if self._phases is None else self._phases
        sizes = np.hypot(*forces.T)
        ripple = np.concatenate(
            [self.gaits[fin].stroke_ripple(sizes[fin : fin + 1]) for fin in range(len(sizes))]
        )
        directions = np.arctan2(-forces[:, 1], forces[:, 0])
        wrench = wrench_ripple(self.allocator.matrix, self._mounts.shafts, directions, ripple)
        phases = state.phases.copy()
        phases[alive] = choose_phases(
            phases[alive], state.action < STARTING, wrench[:, alive], self._inverse
        )
        return phases
