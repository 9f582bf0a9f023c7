"""One action of a robot node, which converts a target wrench to one reference force per fin. NumPy
only.

The ROS 2 node and `robot evaluate` both run this code.
"""

from collections.abc import Sequence

import numpy as np

from softfin.core.action_clock import PAPER_CLOCK
from softfin.robot.allocation import Allocation, FinForces, SixVector
from softfin.robot.bracing import BracedAllocation
from softfin.robot.description import RobotConfig

NODE_CLOCK = PAPER_CLOCK
"""Clock at which the node sends references: three times per second."""


class FinReferences:
    """Reference forces of all fins, with the memory that allocation and bracing need between
    actions."""

    def __init__(self, robot: RobotConfig, max_thrust_n: Sequence[float | int]) -> None:
        """`max_thrust_n` is the maximum mean force of each fin in every direction [N]."""
        self._allocation = BracedAllocation(robot, max_thrust_n)
        self._rest: FinForces = np.zeros((len(robot.fins), 2))
        self._forces = self._rest
        self._brace = self._rest

    @property
    def dead(self) -> tuple[int, ...]:
        """Indices of the fins that were declared dead."""
        return self._allocation.dead

    def declare_dead(self, fin: int) -> None:
        """Stop using a fin; the other fins produce as much of the wrench as possible."""
        self._allocation.declare_dead(fin)

    def act(self, wrench: SixVector | None) -> Allocation:
        """Return the references for the next action, for a wrench in body axes [N, N m].

        Without a wrench, all references are 0.
        """
        if wrench is None:
            # Otherwise, fins that brace each other would keep moving without a target.
            allocation = Allocation(self._rest, np.zeros(6), np.zeros(6, bool))
        else:
            allocation, self._brace = self._allocation.share(wrench, self._forces, self._brace)
        self._forces = allocation.forces
        return allocation
