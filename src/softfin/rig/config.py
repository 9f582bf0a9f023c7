"""A rig's file: which fin, which drive on which bus, which sensor, and the limits of safety. YAML in, checked whole."""

from pathlib import Path

from pydantic import Field, model_validator

from softfin.configuration import Config, Configuration, read_yaml
from softfin.deployment.safety import SafetyConfig
from softfin.errors import ConfigurationError, RigError
from softfin.quantities import TICK_S
from softfin.rig.axia80_config import SensorConfig
from softfin.rig.epos2_config import BusConfig, DriveConfig
from softfin.rig.filter import design
from softfin.rig.ros2_plant import Ros2PlantConfig

DEFAULT = Path("rig.yaml")

ROS2_DEFAULT = Path("ros2.yaml")


class RigConfig(Configuration):
    """Everything that is to know of one rig; what must not be guessed has no default."""

    fin: str = Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]+$")
    """What this fin is called; datasets, surrogates and controllers carry the name on."""
    bus: BusConfig
    """The CAN bus."""
    drive: DriveConfig
    """The EPOS2 on it."""
    sensor: SensorConfig
    """The Axia80."""
    safety: SafetyConfig
    """When to stop."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """How long the fin rests before each log or experiment, for the water to come to rest [s]."""

    @model_validator(mode="after")
    def _consistent(self) -> "RigConfig":
        if self.safety.current_peak_a is None:
            raise ValueError(
                "safety.current_peak_a and current_sustained_a are missing: the motor's data sheet has them (the most "
                "for a moment, the most that it bears for long) [A]"
            )
        ramp, most = self.drive.acceleration_rad_s2, self.safety.acceleration_rad_s2
        if ramp > most:
            raise ValueError(f"drive.acceleration_rad_s2 = {ramp:g} is above safety.acceleration_rad_s2 = {most:g}")
        fastest, most = self.drive.fastest_rad_s, self.safety.velocity_rad_s
        if fastest > most:
            raise ValueError(f"drive.fastest_rad_s = {fastest:g} is above safety.velocity_rad_s = {most:g}")
        delay = len(design(self.sensor.rate_hz, self.sensor.cutoff_hz)) // 2 / self.sensor.rate_hz
        if delay + 2 * TICK_S > self.safety.force_stale_s:
            raise ValueError(
                f"safety.force_stale_s = {self.safety.force_stale_s:g}: the force's filter alone takes {delay:.3f} s; "
                f"give {delay + 5 * TICK_S:.2f} or more, or a higher sensor.cutoff_hz"
            )
        return self


class Ros2Config(Configuration):
    """A fin made of topics of ROS 2."""

    fin: str = Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]+$")
    """What this fin is called; datasets, surrogates and controllers carry the name on."""
    topics: Ros2PlantConfig
    """Where it is read and commanded."""
    safety: SafetyConfig = SafetyConfig()
    """When to stop."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """How long the fin rests before each log or experiment, for the water to come to rest [s]."""


def load_rig(path: Path) -> RigConfig:
    """The rig in a file; raises RigError naming the key, the value and what is allowed."""
    return _load(path, RigConfig, "docs/rig.md has one with comments, and softfin rig emulate writes one of its own")


def load_ros2(path: Path) -> Ros2Config:
    """The topics in a file; likewise."""
    return _load(path, Ros2Config, "docs/rig.md has one with comments")


def _load(path: Path, kind: type[Config], hint: str) -> Config:
    if not path.exists():
        raise RigError(f"{path}: no such file; {hint}")
    try:
        return kind.build(read_yaml(path), str(path))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
