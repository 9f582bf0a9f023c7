"""Configuration of a real fin, read from YAML: which drive on which bus, which sensor, and the
safety limits."""

import math
from pathlib import Path

from pydantic import Field, PrivateAttr, model_validator

from softfin.core.configuration import Config, Configuration, read_yaml
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.rig.axia80.config import Axia80Config
from softfin.rig.epos2.config import BusConfig, Epos2Config
from softfin.rig.filter import BRIDGED_S, design
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.safety import SafetyConfig
from softfin.storage.paths import RIG_FILE, check_readable


class RealFinConfig(Configuration):
    """The settings that every kind of real fin has."""

    fin: str = Field(min_length=1, max_length=100)
    """Name of this fin; datasets, surrogates and controllers carry it on."""
    safety: SafetyConfig = SafetyConfig()
    """Safety limits."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """Time for which the fin rests before each log or experiment, for the water to come to rest
    [s]."""


class EmulationConfig(Configuration):
    """A rig whose drive and sensor are emulated in simulated time, within each program that uses
    it."""

    seed: int = 0
    """Seed of the sensor's noise."""
    tank: JsonObject = Field(default_factory=dict)
    """The tank behind both, where it is not the usual one: as in the file of `softfin rig emulate
    --tank`."""


class RigConfig(RealFinConfig):
    """Configuration of one rig; what must not be guessed has no default."""

    bus: BusConfig
    """The CAN bus."""
    drive: Epos2Config
    """The EPOS2 on the bus."""
    sensor: Axia80Config
    """The Axia80."""
    safety: SafetyConfig
    """Safety limits; a rig's must include the current."""
    emulation: EmulationConfig | None = None
    """Simulated time; None for a rig that is reached over its bus and network, be it real or
    emulated in real time."""
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """The file that it was read from."""
        return self._file

    @model_validator(mode="after")
    def _consistent(self) -> "RigConfig":
        if self.safety.current_peak_a is None:
            raise ValueError(
                "safety.current_peak_a and current_sustained_a are missing: the motor's data "
                "sheet has them (the most for a moment, the most that it bears for long) [A]"
            )
        for own, limit in (
            ("acceleration_rad_s2", "acceleration_rad_s2"),
            ("fastest_rad_s", "velocity_rad_s"),
        ):
            value = getattr(self.drive, own)
            most = getattr(self.safety, limit)
            if value > most:
                raise ValueError(f"drive.{own} = {value:g} is above safety.{limit} = {most:g}")
        delay = len(design(self.sensor.rate_hz, self.sensor.cutoff_hz)) // 2 / self.sensor.rate_hz
        # After a gap that is too long to be bridged, the filter takes twice its delay to fill, and
        # the newest force is by its delay older than the gap. Less would stop the fin over a dozen
        # lost records.
        needed = 3 * delay + 2 * BRIDGED_S
        if self.safety.force_stale_s < needed:
            least = math.ceil(100 * needed) / 100
            raise ValueError(
                f"safety.force_stale_s = {self.safety.force_stale_s:g}: the force's filter alone "
                f"takes {delay:.3f} s, and three times that after lost records; use {least:.2f} or "
                "more, or a higher sensor.cutoff_hz"
            )
        return self


class Ros2Config(RealFinConfig):
    """Configuration of a fin that is reached by topics of ROS 2."""

    topics: Ros2PlantConfig
    """The topics by which it is read and commanded."""


def load_rig(path: Path | None = None) -> RigConfig:
    """Read a rig's file, by default rig.yaml; raises RigError naming the key, the value and what is
    allowed."""
    file = path or RIG_FILE
    config = _load(file, RigConfig)
    config._file = file.resolve()
    return config


def load_ros2(path: Path | None = None) -> Ros2Config:
    """Read the file of a fin behind ROS 2, by default ros2.yaml; likewise."""
    return _load(path or Path("ros2.yaml"), Ros2Config)


def _load(path: Path, kind: type[Config]) -> Config:
    check_readable(
        path,
        RigError,
        "; docs/rig.md has one with comments, and softfin rig emulate writes one of its own",
    )
    try:
        return kind.build(read_yaml(path), str(path))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
