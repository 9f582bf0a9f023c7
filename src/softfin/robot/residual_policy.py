"""A policy that adds to the acceleration by which the motion controller corrects errors. NumPy; JAX in training.

It sees what the controller knows: its estimate, what the fins were made to do, and the path now and later.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import ArtifactError
from softfin.core.operations import operations_of
from softfin.core.quantities import AnyArray
from softfin.robot.description import RobotConfig
from softfin.robot.dynamics import SixVector
from softfin.robot.paths import PathPoint, twist_of
from softfin.storage import artifact as artifacts

ROBOT_POLICY_KIND = "robot-policy"

TRAINED_FOR = ("body", "fins", "allocation", "control")
"""Parts of a robot's file that a policy is trained for."""

LATER_S = (0.5, 1.0, 2.0)
"""Times after now at which a policy sees the path [s]."""

OBSERVED = 18 + 12 + 6 * (1 + len(LATER_S))
"""Numbers that a policy sees."""

ERROR = np.array([0.02, 0.02, 0.02, 0.05, 0.05, 0.05])
RATE = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
TWIST = np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
"""Usual sizes of what it sees [m, rad; and per s]."""


def observed(
    estimate: Float[AnyArray, "6 3"], accelerations: Float[AnyArray, "2 6"], path: Sequence[PathPoint], bound: SixVector
) -> Float[AnyArray, "inputs"]:
    """Return the numbers that a policy sees, each over its usual size; `path` is that now and `LATER_S` after."""
    xp, (error, rate, disturbance) = operations_of(estimate, bound).xp, estimate.T
    # Axes in which the fins make nothing have no usual size.
    bound = xp.where(bound > 0, bound, 1.0)
    twists = [twist_of(point) / TWIST for point in path]
    changes = [later - twists[0] for later in twists[1:]]
    parts = [error / ERROR, rate / RATE, disturbance / bound, (accelerations / bound).reshape(-1), twists[0], *changes]
    numbers: Float[AnyArray, inputs] = xp.concatenate(parts)
    return numbers


class Perceptron(NamedTuple):
    """A network with two hidden layers."""

    first: Float[AnyArray, "inputs hidden"]
    first_bias: Float[AnyArray, "hidden"]
    second: Float[AnyArray, "hidden hidden"]
    second_bias: Float[AnyArray, "hidden"]
    last: Float[AnyArray, "hidden outputs"]

    def __call__(self, inputs: Float[AnyArray, "inputs"]) -> Float[AnyArray, "outputs"]:
        """Return the outputs, without limits."""
        xp = operations_of(inputs).xp
        hidden = xp.tanh(inputs @ self.first + self.first_bias)
        hidden = xp.tanh(hidden @ self.second + self.second_bias)
        outputs: Float[AnyArray, outputs] = hidden @ self.last
        return outputs


class ResidualPolicy(NamedTuple):
    """A network whose outputs are bounded."""

    network: Perceptron
    bound: SixVector
    """Greatest acceleration that it adds, axis by axis [m/s2, rad/s2]."""

    def act(
        self, estimate: Float[AnyArray, "6 3"], accelerations: Float[AnyArray, "2 6"], path: Sequence[PathPoint]
    ) -> SixVector:
        """Return the acceleration to add, in body axes; `path` is that now and `LATER_S` after."""
        inputs = observed(estimate, accelerations, path, self.bound)
        added: SixVector = self.bound * operations_of(inputs).xp.tanh(self.network(inputs))
        return added

    def save(self, path: Path, robot: RobotConfig, training: Mapping[str, Any], overwrite: bool = False) -> None:
        """Write a folder with the weights, the robot that it is for, and how it was trained."""
        description = {"robot": robot.model_dump(mode="json"), **training}
        weights = {**self.network._asdict(), "bound": self.bound}
        artifacts.save(path, ROBOT_POLICY_KIND, description, weights, overwrite=overwrite)

    @classmethod
    def load(cls, path: Path, robot: RobotConfig) -> "ResidualPolicy":
        """Load the policy of a robot; raises ArtifactError where the folder holds another thing, or another robot's."""
        description, weights = artifacts.load(path, ROBOT_POLICY_KIND)
        own = robot.model_dump(mode="json")
        theirs = description.get("robot", {})
        other = [name for name in own if name in TRAINED_FOR and own[name] != theirs.get(name)]
        if other:
            raise ArtifactError(f"{path}: trained for another {' and another '.join(other)} than this robot's; train "
                                "one for it: softfin robot train")  # fmt: skip
        names = (*Perceptron._fields, "bound")
        hidden = weights["first"].shape[-1] if set(weights) == set(names) else 0
        shapes = (OBSERVED, hidden), (hidden,), (hidden, hidden), (hidden,), (hidden, 6), (6,)
        if not hidden or any(
            weights[name].shape != shape or not np.isfinite(weights[name]).all()
            for name, shape in zip(names, shapes, strict=True)
        ):
            raise ArtifactError(f"{path}: its weights are not those of a policy for robots; copy it again")
        bound = weights.pop("bound")
        return cls(Perceptron(**weights), bound)
