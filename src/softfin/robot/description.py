"""The robot's file: body, fins, allocation and motion control. `ucat` is built in. Does not import
JAX."""

from importlib.resources import files
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration, parse_yaml, read_yaml
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import AnyArray
from softfin.robot.body_config import BodyConfig, Three
from softfin.robot.control_config import AllocationConfig, ControlConfig
from softfin.robot.rotation import cross

BUILT_IN = ("ucat",)
"""Robots included in softfin."""

WRENCH_AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
"""Names of the six components of a wrench or twist."""

UNIT_TOLERANCE = 1e-3


class FinMountConfig(Configuration):
    """A fin's mount on the body, and the fin's plant."""

    position_m: Three
    """Position of the shaft, where the fin's force acts [m]."""
    zero_direction: Three
    """Unit vector of the fin's thrust on the body at shaft angle 0, i.e. the x axis of the fin."""
    shaft_axis: Three
    """Unit vector along the shaft; positive angles follow the right-hand rule."""
    range_rad: tuple[float, float] | None = None
    """Minimum and maximum shaft angle [rad]; None means unlimited rotation. Limited ranges are not
    supported yet."""
    plant: str = "tank"
    """Plant of the fin: tank, or the YAML file of another tank; ignored on a real robot."""

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
        if self.range_rad is not None and not self.range_rad[0] < self.range_rad[1]:
            raise ValueError(
                f"range_rad = {list(self.range_rad)}: the first angle must be smaller than the "
                "second; use ascending angles"
            )
        return self

    def axes(self) -> Float[np.ndarray, "3 2"]:
        """Return the x and y axes of the fin's forces, as columns in body axes."""
        x = np.asarray(self.zero_direction)
        shaft = np.asarray(self.shaft_axis)
        # A positive angle turns thrust from +x towards -y.
        return np.stack([x, np.cross(x, shaft)], axis=1)


class FinMounts(NamedTuple):
    """Mounts of all fins of a robot, in body axes."""

    places: Float[np.ndarray, "fins 3"]
    """Positions of the shafts [m]."""
    axes: Float[np.ndarray, "fins 3 2"]
    """x and y axes of each fin's forces, as columns."""
    shafts: Float[np.ndarray, "fins 3"]
    """Unit vectors along the shafts."""

    def velocities(self, twist: Float[AnyArray, "6"]) -> list[Float[AnyArray, "2"]]:
        """Return each mount's velocity in the fin's axes [m/s] for a twist of the body [m/s,
        rad/s]."""
        # v + omega x r, in the axes of the fin.
        places = zip(self.places, self.axes, strict=True)
        return [(twist[:3] + cross(twist[3:], place)) @ axes for place, axes in places]


class RobotConfig(Configuration):
    """Configuration of a robot with fins."""

    name: str
    """Name of the robot."""
    size_m: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (0.5, 0.3, 0.2)
    """Length, width and height [m]; used only for drawing."""
    body: BodyConfig
    """Body without its fins."""
    fins: dict[str, FinMountConfig] = Field(min_length=1, max_length=7)
    """Fins by name; at most 7, because all phase patterns are tried."""
    allocation: AllocationConfig = AllocationConfig()
    """Allocation of a wrench to the fins."""
    control: ControlConfig = ControlConfig()
    """Motion control."""
    silent_fin: Literal["stop", "dead"] = "stop"
    """Reaction to a fin that has a fault or falls silent. stop: stop the robot; dead: continue
    without the fin."""

    def mounts(self) -> FinMounts:
        """Return the mounts of all fins, in the order of `fins`."""
        fins = self.fins.values()
        return FinMounts(
            np.array([fin.position_m for fin in fins], float),
            np.array([fin.axes() for fin in fins]),
            np.array([fin.shaft_axis for fin in fins], float),
        )

    def matrix(self) -> Float[np.ndarray, "6 columns"]:
        """Return the allocation matrix: its columns are the wrenches on the body, in body axes, of
        unit forces along x and y of the first fin, then of the second, and so on."""
        places, axes, _ = self.mounts()
        # For each fin: its axes (force), stacked on position x axes (moment).
        columns = [
            np.concatenate([a, np.cross(place, a, axisb=0).T])
            for place, a in zip(places, axes, strict=True)
        ]
        return np.concatenate(columns, axis=1)


def load_robot(name: str) -> RobotConfig:
    """Load a built-in robot or a YAML file; raises ConfigurationError with a one-line message if
    that fails."""
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
