"""A rig's file: which fin, which drive on which bus, which sensor, and the limits of safety. YAML in, checked whole."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PrivateAttr, model_validator

from softfin.core.configuration import Config, Configuration, read_yaml
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.quantities import TICK_S
from softfin.rig.axia80.config import SensorConfig
from softfin.rig.epos2.config import BusConfig, Epos2Config
from softfin.rig.filter import design
from softfin.rig.ros2.plant import Ros2PlantConfig
from softfin.rig.safety import SafetyConfig
from softfin.storage.paths import find_rig_file


def _shown_as_it_is(name: str) -> str:
    if not name.isprintable():
        raise ValueError("a name is of letters that can be printed")
    return name


FinName = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_shown_as_it_is)]


class EmulationConfig(Configuration):
    """Of a rig whose drive and sensor are emulated in simulated time, within each program that uses it."""

    seed: int = 0
    """Of the sensor's noise."""
    tank: dict[str, Any] = Field(default_factory=dict)
    """The tank behind both, where it is not the usual one: as in the file of `softfin rig emulate --tank`."""


class RigConfig(Configuration):
    """Everything that is to know of one rig; what must not be guessed has no default."""

    fin: FinName
    """What this fin is called; datasets, surrogates and controllers carry the name on."""
    bus: BusConfig
    """The CAN bus."""
    drive: Epos2Config
    """The EPOS2 on it."""
    sensor: SensorConfig
    """The Axia80."""
    safety: SafetyConfig
    """When to stop."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """How long the fin rests before each log or experiment, for the water to come to rest [s]."""
    emulation: EmulationConfig | None = None
    """None for a rig that is reached over its bus and network, be it emulated in real time or there."""
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """Where it was read from."""
        return self._file

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

    fin: FinName
    """What this fin is called; datasets, surrogates and controllers carry the name on."""
    topics: Ros2PlantConfig
    """Where it is read and commanded."""
    safety: SafetyConfig = SafetyConfig()
    """When to stop."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """How long the fin rests before each log or experiment, for the water to come to rest [s]."""


def load_rig(path: Path | None = None) -> RigConfig:
    """The rig in a file, by default rig.yaml; raises RigError naming the key, the value and what is allowed."""
    file = find_rig_file("rig", path)
    config = _load(file, RigConfig)
    config._file = file.resolve()
    return config


def load_ros2(path: Path | None = None) -> Ros2Config:
    """The topics in a file, by default ros2.yaml; likewise."""
    return _load(find_rig_file("ros2", path), Ros2Config)


def _load(path: Path, kind: type[Config]) -> Config:
    try:
        return kind.build(read_yaml(path), str(path))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
