"""The robot's file: its body, its fins, and the control of its motion. `ucat` is built in. No
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
"""Robots that are part of softfin."""

WRENCH_AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
"""Names of the six numbers of a wrench or a twist."""

UNIT_TOLERANCE = 1e-3


class FinMountConfig(Configuration):
    """Mount of a fin on the body, and the fin's plant."""

    position_m: Three
    """Position of the shaft, where the fin's force acts [m]."""
    zero_direction: Three
    """Unit vector along which the fin's thrust pushes the body when the shaft is at angle 0: x of
    the fin's axes."""
    shaft_axis: Three
    """Unit vector about which positive angles turn, by the right-hand rule."""
    range_rad: tuple[float, float] | None = None
    """Smallest and largest angle of the shaft [rad]; none: it turns without limit. Other values are
    not supported yet."""
    plant: str = "tank"
    """Fin: tank, or the YAML file of another tank; it is ignored on a real robot."""

    @model_validator(mode="after")
    def _has_axes(self) -> "FinMountConfig":
        for name in ("zero_direction", "shaft_axis"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1) > UNIT_TOLERANCE:
                raise ValueError(
                    f"{name} = {list(getattr(self, name))} has length {length:.4g}; give a unit "
                    "vector"
                )
        along = float(np.dot(self.zero_direction, self.shaft_axis))
        if abs(along) > UNIT_TOLERANCE:
            raise ValueError(
                f"zero_direction and shaft_axis have the scalar product {along:.3g}; a fin pushes "
                "at right angles to its shaft"
            )
        if self.range_rad is not None and not self.range_rad[0] < self.range_rad[1]:
            raise ValueError(f"range_rad = {list(self.range_rad)}: give the smaller angle first")
        return self

    def axes(self) -> Float[np.ndarray, "3 2"]:
        """Return the x and y of the fin's own forces, as columns in body axes."""
        x = np.asarray(self.zero_direction)
        shaft = np.asarray(self.shaft_axis)
        # A positive angle turns thrust from +x towards -y.
        return np.stack([x, np.cross(x, shaft)], axis=1)


class FinMounts(NamedTuple):
    """Mounts of all fins of a robot, in body axes."""

    places: Float[np.ndarray, "fins 3"]
    """Shafts [m]."""
    axes: Float[np.ndarray, "fins 3 2"]
    """The x and y of each fin's own forces, as columns."""
    shafts: Float[np.ndarray, "fins 3"]
    """Unit vectors along the shafts."""

    def velocities(self, twist: Float[AnyArray, "6"]) -> list[Float[AnyArray, "2"]]:
        """Return each mount's velocity in its own axes [m/s] from a twist of the body [m/s,
        rad/s]."""
        places = zip(self.places, self.axes, strict=True)
        return [(twist[:3] + cross(twist[3:], place)) @ axes for place, axes in places]


class RobotConfig(Configuration):
    """A robot with fins."""

    name: str
    """Name of the robot."""
    size_m: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (0.5, 0.3, 0.2)
    """Length, width, height [m]; only for drawing."""
    body: BodyConfig
    """Body without fins."""
    fins: dict[str, FinMountConfig] = Field(min_length=1, max_length=7)
    """Fins by name; with more, there would be too many patterns of phases to try."""
    allocation: AllocationConfig = AllocationConfig()
    """How a wrench is allocated to the fins."""
    control: ControlConfig = ControlConfig()
    """How motion is controlled."""
    silent_fin: Literal["stop", "dead"] = "stop"
    """When a fin has a fault or falls silent: stop the robot, or continue without it."""

    def mounts(self) -> FinMounts:
        """Return the mounts of the fins, in their order."""
        fins = self.fins.values()
        return FinMounts(
            np.array([fin.position_m for fin in fins], float),
            np.array([fin.axes() for fin in fins]),
            np.array([fin.shaft_axis for fin in fins], float),
        )

    def matrix(self) -> Float[np.ndarray, "6 columns"]:
        """Return the wrenches, in body axes, of unit forces at the fins: columns are x and y of the
        first fin, then of the second."""
        places, axes, _ = self.mounts()
        columns = [
            np.concatenate([a, np.cross(place, a, axisb=0).T])
            for place, a in zip(places, axes, strict=True)
        ]
        return np.concatenate(columns, axis=1)


def load_robot(name: str) -> RobotConfig:
    """Load a built-in robot or a YAML file; raises ConfigurationError with a one-line message for
    anything else."""
    if name in BUILT_IN:
        text = files("softfin.robot").joinpath(f"robots/{name}.yaml").read_text()
        return RobotConfig.build(parse_yaml(text), name)
    path = Path(name)
    if not path.is_file():
        raise ConfigurationError(
            f"robot {name}: there is no such file; give a YAML file, or {', '.join(BUILT_IN)}, "
            "which is built in"
        )
    return RobotConfig.build(read_yaml(path), name)
