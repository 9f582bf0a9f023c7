"""Convert a target wrench to commands for all fins, once per action: allocation, bracing, phases,
gaits. NumPy only.

driver = WrenchDriver(robot, gaits)
state = driver.init()
state, orders = driver.act(state, wrench)     # 3 times per second; send orders.commands to the fins
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
"""Twist of a body at rest."""

STARTING = 2
"""Number of initial actions in which the fins' phases can be chosen freely."""


class FinOrders(NamedTuple):
    """Orders to the fins for one action, and the resulting wrench."""

    commands: tuple[Command, ...]
    """Command for each fin [rad, rad/s]."""
    delays: tuple[int, ...]
    """Delay from the start of the action to each fin's command, in ticks of 10 ms; until then, the
    previous command stays active."""
    forces: FinForces
    """Mean force of each fin, in the fin's axes [N]."""
    wrench: SixVector
    """Total wrench of these forces in still water, in body axes [N, N m]."""
    given_up: Bool[np.ndarray, "6"]
    """Axes in which the target wrench is out of reach."""

    def told(self, wrench: SixVector) -> str:
        """Describe the part of a target wrench that is out of reach; returns an empty string if
        there is none."""
        if not self.given_up.any():
            return ""
        units = ("N",) * 3 + ("N m",) * 3
        parts = [
            f"{WRENCH_AXES[i]} {self.wrench[i]:.2f} of {wrench[i]:.2f} {units[i]}"
            for i in np.flatnonzero(self.given_up)
        ]
        return "out of the fins' reach: " + ", ".join(parts)


class WrenchDriverState(NamedTuple):
    """State of the driver between actions."""

    forces: FinForces
    """Forces of the previous action [N]."""
    brace: FinForces
    """Bracing in the previous action: forces that cancel each other [N]."""
    action: int
    """Number of actions so far."""
    phases: Phases
    """Phase of each fin's strokes, 0 to 5."""
    fins: tuple[DriverState, ...]


class WrenchDriver:
    """Driver that converts wrenches to commands for the fins of one robot; with `phases`, the fins
    keep these phases."""

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
        """Allocator with the reaches of the working fins."""
        return self._allocation.allocator

    @property
    def dead(self) -> tuple[int, ...]:
        """Indices of the fins declared dead."""
        return self._allocation.dead

    def init(self) -> WrenchDriverState:
        """Return the initial state, with the fins at rest at angle 0."""
        count = len(self.gaits)
        none = np.zeros((count, 2))
        return WrenchDriverState(none, none, 0, np.zeros(count, int), (REST,) * count)

    def declare_dead(self, fin: int) -> None:
        """Stop using a fin; the others produce as much of the wrench as they can."""
        self._allocation.declare_dead(fin)

    def act(
        self, state: WrenchDriverState, wrench: SixVector, twist: SixVector = STILL
    ) -> tuple[WrenchDriverState, FinOrders]:
        """Return the orders for one action of 1/3 s, for a mean wrench in body axes [N, N m].

        `twist` is the expected motion of the body through the water [m/s, rad/s]; the fins
        compensate for the resulting loss of force.

        Raises:
            RunError: the wrench is not finite.
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
                # A dead fin keeps its last target.
                fins.append(state.fins[fin])
                commands.append(fin_command(state.fins[fin].target, gaits.limits.velocity_min))
                continue
            side = stroke_side(int(phases[fin]), state.action)
            # Compensate for the force lost through the motion of the fin's mount.
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
        # At angle a the thrust points along (cos a, -sin a).
        directions = np.arctan2(-forces[:, 1], forces[:, 0])
        wrench = wrench_ripple(self.allocator.matrix, self._mounts.shafts, directions, ripple)
        phases = state.phases.copy()
        phases[alive] = choose_phases(
            phases[alive], state.action < STARTING, wrench[:, alive], self._inverse
        )
        return phases
