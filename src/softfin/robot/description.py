"""The robot file: fins and allocation. `ucat` is built in. This module does not import JAX."""

from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from softfin.core.configuration import Configuration, parse_yaml, read_yaml
from softfin.core.errors import ConfigurationError

BUILT_IN = ("ucat",)
"""Robots included in softfin."""

WRENCH_AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
"""Names of the six components of a wrench or twist."""

UNIT_TOLERANCE = 1e-3

Three = tuple[float, float, float]
Six: TypeAlias = tuple[
    PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat
]

MaxThrust: TypeAlias = PositiveFloat | dict[str, PositiveFloat]
"""Maximum mean force that each fin can produce in every direction [N]: one number for all, or one
per fin name."""


class FinMountConfig(Configuration):
    """The mount of a fin on the body."""

    position_m: Three
    """Position of the shaft, where the fin force acts [m]."""
    zero_direction: Three
    """Unit vector of the fin thrust on the body at shaft angle 0, i.e. the x axis of the fin."""
    shaft_axis: Three
    """Unit vector along the shaft; positive angles follow the right-hand rule."""

    @model_validator(mode="after")
    def _has_axes(self) -> "FinMountConfig":
        for name in ("zero_direction", "shaft_axis"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1) > UNIT_TOLERANCE:
                raise ValueError(
                    f"{name} = {list(getattr(self, name))} has length {length:.4g}; use a unit "
                    "vector"
                )
        along = float(np.dot(self.zero_direction, self.shaft_axis))
        if abs(along) > UNIT_TOLERANCE:
            raise ValueError(
                f"zero_direction and shaft_axis have the scalar product {along:.3g}, but a fin "
                "pushes at right angles to its shaft; make them perpendicular"
            )
        return self

    def axes(self) -> Float[np.ndarray, "3 2"]:
        """Return the x and y axes of the fin force as columns in body axes."""
        x = np.asarray(self.zero_direction)
        shaft = np.asarray(self.shaft_axis)
        # A positive angle turns thrust from +x towards -y.
        return np.stack([x, np.cross(x, shaft)], axis=1)


class AllocationConfig(Configuration):
    """Allocation of a wrench to the fins."""

    priority: Six = (1, 1, 1, 30, 30, 30)
    """Cost of a squared wrench error for each axis; 1 N m costs about as much as 5 N, because a
    tilted robot pushes in the wrong direction."""
    brace_n: NonNegativeFloat = 1.5
    """Minimum force of each fin, as far as the other fins can cancel it [N]. The direction of a
    weak force jumps with every small change of the wrench, and a fin that swings around pushes
    sideways. 0 means no bracing."""


class RobotConfig(Configuration):
    """Configuration of a robot with fins."""

    name: str
    """Name of the robot."""
    fins: dict[str, FinMountConfig] = Field(min_length=1)
    """Fins by name."""
    allocation: AllocationConfig = AllocationConfig()
    """Allocation of a wrench to the fins."""
    silent_fin: Literal["stop", "dead"] = "stop"
    """Reaction to a fin that has a fault or falls silent. stop: stop the robot; dead: continue
    without the fin."""

    def matrix(self) -> Float[np.ndarray, "6 columns"]:
        """Return the allocation matrix: its columns are the wrenches on the body, in body axes, of
        unit forces along x and y of the first fin, then of the second, and so on."""
        # For each fin: its axes (force), stacked on position x axes (moment).
        columns = []
        for fin in self.fins.values():
            axes = fin.axes()
            moments = np.cross(np.asarray(fin.position_m), axes, axisb=0).T
            columns.append(np.concatenate([axes, moments]))
        return np.concatenate(columns, axis=1)


def max_thrust_per_fin(robot: RobotConfig, max_thrust: MaxThrust | None) -> list[float]:
    """Return the maximum mean force of each fin [N]; raises ConfigurationError if a value is
    missing."""
    names = list(robot.fins)
    if max_thrust is None:
        raise ConfigurationError(
            "max_thrust: missing; set it to the maximum mean force that each fin can produce in "
            "every direction with its controller [N], e.g. --max-thrust 3"
        )
    if not isinstance(max_thrust, dict):
        return [max_thrust] * len(names)
    if set(max_thrust) != set(names):
        raise ConfigurationError(
            f"max_thrust is for {', '.join(max_thrust)}, but {robot.name} has {', '.join(names)}; "
            "set one number for all fins, or one for each fin"
        )
    return [max_thrust[name] for name in names]


def load_robot(name: str) -> RobotConfig:
    """Load a built-in robot or a YAML file; raises ConfigurationError with a one-line message on
    failure."""
    if name in BUILT_IN:
        text = files("softfin.robot").joinpath(f"robots/{name}.yaml").read_text()
        return RobotConfig.build(parse_yaml(text), name)
    path = Path(name)
    if not path.is_file():
        raise ConfigurationError(
            f"robot {name}: file not found; use a YAML file or the built-in robot "
            f"{', '.join(BUILT_IN)}"
        )
    return RobotConfig.build(read_yaml(path), name)
