"""A wrench asked for becomes commands for all fins, action by action: allocation, bracing, phases, gaits. NumPy alone.

driver = WrenchDriver(robot, gaits)
state = driver.init()
state, orders = driver.act(state, wrench)     # 3 times a second; orders.commands go to the fins
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from softfin.core.errors import RunError
from softfin.core.quantities import Command
from softfin.robot.allocation import Allocator, Forces, SixVector
from softfin.robot.description import AXES, RobotConfig
from softfin.robot.fin_driver import REST, DriverState, FinGaits, fin_command, stroke
from softfin.robot.phases import Phases, choose_phases, delay_of, side_of, wrench_ripple
from softfin.robot.rotation import cross

WAYS, SIZES = 8, (0.5, 1.0, 1.5)
"""Bracing that is tried: ways within the forces that cancel, sizes over the least force."""


STILL = np.zeros(6)
"""Twist of a body that does not move."""

STARTING = 2
"""First actions, in which the fins' phases are free."""


class FinOrders(NamedTuple):
    """Orders to the fins for one action, and the wrench that they make."""

    commands: tuple[Command, ...]
    """For each fin [rad, rad/s]."""
    delays: tuple[int, ...]
    """Ticks of 10 ms into the action at which each fin gets its command; until then it keeps the one before."""
    forces: Forces
    """Mean force of each fin in its own axes [N]."""
    wrench: SixVector
    """Wrench that they make in still water, in body axes [N, N m]."""
    given_up: Bool[np.ndarray, "6"]
    """Axes in which the wrench asked for is beyond the fins."""

    def told(self, wrench: SixVector) -> str:
        """Say in words what was given up of a wrench that was asked for; empty where nothing was."""
        if not self.given_up.any():
            return ""
        units = ("N",) * 3 + ("N m",) * 3
        parts = [f"{AXES[i]} {self.wrench[i]:.2f} of {wrench[i]:.2f} {units[i]}" for i in np.flatnonzero(self.given_up)]
        return "beyond the fins' reach: " + ", ".join(parts)


class WrenchDriverState(NamedTuple):
    """State of the driver between actions."""

    forces: Forces
    """Forces of the last action [N]."""
    brace: int
    """Bracing of the last action, by its number."""
    action: int
    """Actions so far."""
    phases: Phases
    """Phase of each fin's strokes, 0 to 5."""
    fins: tuple[DriverState, ...]


class WrenchDriver:
    """Turns wrenches into commands for the fins of one robot; with `phases` the fins keep these."""

    def __init__(self, robot: RobotConfig, gaits: Sequence[FinGaits], phases: Phases | None = None) -> None:
        self.robot, self.gaits, self._phases = robot, tuple(gaits), phases
        config = robot.allocation
        reach = np.array([each.reach for each in gaits])
        self._allocator = Allocator(robot.matrix(), reach, np.asarray(config.priority, float))
        self._shafts = np.array([fin.shaft_axis for fin in robot.fins.values()], float)
        self._places = np.array([fin.position_m for fin in robot.fins.values()], float)
        self._axes = np.array([fin.axes() for fin in robot.fins.values()])
        self._inverse = np.linalg.inv(robot.body.own_inertia() + np.diag(robot.body.added_mass))
        self.dead: tuple[int, ...] = ()
        self._braces = self._bracing()

    @property
    def allocator(self) -> Allocator:
        """The allocation, with the reaches of the fins that are alive."""
        return self._allocator

    def init(self) -> WrenchDriverState:
        """Return the state of fins at rest at angle 0."""
        count = len(self.gaits)
        return WrenchDriverState(np.zeros((count, 2)), 0, 0, np.zeros(count, int), (REST,) * count)

    def declare_dead(self, fin: int) -> None:
        """Ask nothing more of a fin; the others make what they can."""
        self.dead = (*self.dead, fin)
        reach = self._allocator.reach.copy()
        reach[fin] = 0
        self._allocator.reach = reach
        self._braces = self._bracing()

    def act(
        self, state: WrenchDriverState, wrench: SixVector, twist: SixVector = STILL
    ) -> tuple[WrenchDriverState, FinOrders]:
        """Take one action of 1/3 s for a mean wrench in body axes [N, N m].

        `twist` is that with which the body is going to move through the water, as far as it is known [m/s, rad/s]: its
        fins then make up for the force that they lose by it.

        Raises:
            RunError: the wrench is not of finite numbers; the state is as it was.
        """
        wrench = np.asarray(wrench, float)
        if not np.isfinite(wrench).all():
            raise RunError(f"wrench {wrench.tolist()}: must be six finite numbers, 3 forces [N] and 3 moments [N m]")
        start = state.forces
        brace = self._brace(self._allocator.allocate(wrench, start=start).forces, state.brace)
        found = self._allocator.allocate(wrench, self._braces[brace], start)
        smoothing = self.robot.allocation.smoothing
        forces = smoothing * state.forces + (1 - smoothing) * found.forces
        alive = [fin for fin in range(len(self.gaits)) if fin not in self.dead]
        phases = self._choose_phases(state, forces, alive)
        fins, commands = [], []
        for fin, gaits in enumerate(self.gaits):
            if fin in self.dead:
                fins.append(state.fins[fin])
                commands.append(fin_command(state.fins[fin].target, gaits.limits.velocity_min))
                continue
            side = side_of(int(phases[fin]), state.action)
            velocity = (twist[:3] + cross(twist[3:], self._places[fin])) @ self._axes[fin]
            moved, command = stroke(gaits, state.fins[fin], forces[fin] + gaits.lost(forces[fin], velocity), side)
            fins.append(moved)
            commands.append(command)
        after = WrenchDriverState(forces, brace, state.action + 1, phases, tuple(fins))
        together = self._allocator.matrix @ forces.ravel()
        delays = tuple(delay_of(int(phase)) for phase in phases)
        return after, FinOrders(tuple(commands), delays, forces, together, found.given_up)

    def _choose_phases(self, state: WrenchDriverState, forces: Forces, alive: list[int]) -> Phases:
        if self._phases is not None:
            return self._phases
        sizes = np.hypot(*forces.T)
        ripple = np.concatenate([self.gaits[fin].ripple_of(sizes[fin : fin + 1]) for fin in range(len(sizes))])
        directions = np.arctan2(-forces[:, 1], forces[:, 0])
        wrench = wrench_ripple(self._allocator.matrix, self._shafts, directions, ripple)
        phases = state.phases.copy()
        phases[alive] = choose_phases(phases[alive], state.action < STARTING, wrench[:, alive], self._inverse)
        return phases

    def _bracing(self) -> Float[np.ndarray, "braces fins 2"]:
        """Forces that cancel one another, about the least force in size; the first is none."""
        reach = self._allocator.reach
        weighted = self._allocator.matrix * np.repeat(reach > 0, 2)
        _, values, rows = np.linalg.svd(weighted)
        rank = int((values > 1e-6 * values[0]).sum())
        # Of the directions that make no wrench, those of dead fins are none.
        free = [row for row in rows[rank:] if np.abs(row[np.repeat(reach > 0, 2)]).max() > 1e-6]
        basis = np.array([row * np.repeat(reach > 0, 2) for row in free]).reshape(-1, len(rows))
        least = self.robot.allocation.brace_n
        found = [np.zeros(len(rows))]
        if least and len(basis):
            for angle, size in itertools.product(np.linspace(0, 2 * np.pi, WAYS, endpoint=False), SIZES):
                way = basis[0] * np.cos(angle) + (basis[1] * np.sin(angle) if len(basis) > 1 else 0)
                greatest = np.sqrt((way.reshape(-1, 2) ** 2).sum(axis=1)).max()
                if greatest > 1e-6:
                    found.append(size * least * way / greatest)
        return np.array(found).reshape(len(found), -1, 2)

    def _brace(self, forces: Forces, present: int) -> int:
        """Return the bracing under which fins make the least force, or nearly so, with little effort."""
        least = self.robot.allocation.brace_n
        if len(self._braces) == 1:
            return 0
        alive = self._allocator.reach > 0
        together = forces + self._braces
        sizes = np.sqrt((together**2).sum(axis=2))
        lacking = (np.maximum(least - sizes, 0) ** 2)[:, alive].sum(axis=1)
        beyond = (np.maximum(sizes - self._allocator.reach, 0) ** 2)[:, alive].sum(axis=1)
        costs = lacking + 10 * beyond + EFFORT * (together**2).sum(axis=(1, 2))
        costs[present] -= self.robot.allocation.brace_change
        return int(costs.argmin())


EFFORT = 0.02
"""Cost of a newton of force, squared, against that of a newton too little."""
