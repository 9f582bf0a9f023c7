"""Configuration of a real fin, read from YAML: bus, drive, sensor and safety limits."""

import math
from pathlib import Path

from pydantic import Field, PrivateAttr, model_validator

from softfin.core.configuration import Config, Configuration, read_yaml
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.epos2.config import BusConfig, Epos2Config
from softfin.rig.filter import BRIDGED_S, design
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.safety import SafetyConfig
from softfin.storage.paths import RIG_FILE, check_readable


class RealFinConfig(Configuration):
    """Settings common to all kinds of real fins."""

    fin: str = Field(min_length=1, max_length=100)
    """Name of this fin; datasets, surrogates and controllers inherit it."""
    safety: SafetyConfig = SafetyConfig()
    """Safety limits."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """Rest time before each log or experiment, so that the water calms down [s]."""


class EmulationConfig(Configuration):
    """Emulation of a rig's drive and sensor in simulated time, within each program that uses the
    rig."""

    seed: int = 0
    """Seed of the sensor's noise."""
    tank: JsonObject = Field(default_factory=dict)
    """Tank around the fin, as in the file for `softfin rig emulate --tank`; empty for the default
    tank."""


class RigConfig(RealFinConfig):
    """Configuration of one rig; values that depend on your hardware have no default."""

    bus: BusConfig
    """The CAN bus."""
    drive: Epos2Config
    """The EPOS2 on the bus."""
    sensor: Axia80Config
    """The Axia80."""
    safety: SafetyConfig
    """Safety limits; the current limits are required for a rig."""
    emulation: EmulationConfig | None = None
    """Emulation in simulated time; None for a real rig or one emulated in real time."""
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """File from which the configuration was read; None if it was built in Python."""
        return self._file

    @model_validator(mode="after")
    def _consistent(self) -> "RigConfig":
        if self.safety.current_peak_a is None:
            raise ValueError(
                "safety.current_peak_a and current_sustained_a are missing; set them to the "
                "motor's peak and maximum continuous current [A], from its data sheet"
            )
        for own, limit in (
            ("acceleration_rad_s2", "acceleration_rad_s2"),
            ("fastest_rad_s", "velocity_rad_s"),
        ):
            value = getattr(self.drive, own)
            most = getattr(self.safety, limit)
            if value > most:
                raise ValueError(
                    f"drive.{own} = {value:g} exceeds safety.{limit} = {most:g}; lower one or "
                    "raise the other"
                )
        # The delay of a symmetric filter is half its length.
        delay = len(design(self.sensor.rate_hz, self.sensor.cutoff_hz)) // 2 / self.sensor.rate_hz
        # After a gap too long to bridge, the filter takes twice its delay to refill, and the latest
        # force is one delay older than the gap. A shorter limit would stop the fin because of a
        # dozen lost records.
        needed = 3 * delay + 2 * BRIDGED_S
        if self.safety.force_stale_s < needed:
            least = math.ceil(100 * needed) / 100
            raise ValueError(
                f"safety.force_stale_s = {self.safety.force_stale_s:g}: the force filter alone "
                f"delays by {delay:.3f} s, and by three times that after lost records; use "
                f"{least:.2f} or more, or a higher sensor.cutoff_hz"
            )
        return self


class Ros2Config(RealFinConfig):
    """Configuration of a fin behind ROS 2 topics."""

    topics: Ros2PlantConfig
    """Topics for the fin's readings and commands."""


def load_rig(path: Path | None = None) -> RigConfig:
    """Load a rig's file (default: rig.yaml); raises RigError with the key, its value and the
    allowed values."""
    file = path or RIG_FILE
    config = _load(file, RigConfig)
    config._file = file.resolve()
    return config


def load_ros2(path: Path | None = None) -> Ros2Config:
    """Load the file of a fin behind ROS 2 (default: ros2.yaml); raises RigError like `load_rig`."""
    return _load(path or Path("ros2.yaml"), Ros2Config)


def _load(path: Path, kind: type[Config]) -> Config:
    check_readable(
        path,
        RigError,
        "; copy the example in docs/rig.md, or run softfin rig emulate for an emulated rig",
    )
    try:
        return kind.build(read_yaml(path), str(path))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
