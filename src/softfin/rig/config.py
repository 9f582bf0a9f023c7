"""Configuration of a real fin, read from YAML: bus, drive, sensor and safety limits."""

from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field, PrivateAttr, SerializeAsAny, model_validator

from softfin.control.feedback import FeedbackConfig
from softfin.core.configuration import Chosen, Config, Configuration, read_yaml
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.rig.bus import BusConfig
from softfin.rig.device import DriveConfig, ForceSensorConfig
from softfin.rig.device_type import DriveType, ForceSensorType
from softfin.rig.devices.registry import choose_config
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.safety import SafetyConfig
from softfin.storage.paths import RIG_FILE, check_readable


class RealFinConfig(Configuration):
    """Settings common to all kinds of real fins."""

    fin: str = Field(min_length=1, max_length=100)
    """Name of this fin; datasets, surrogates and controllers inherit it."""
    safety: SafetyConfig = SafetyConfig()
    """Safety limits."""
    feedback: FeedbackConfig = FeedbackConfig()
    """Settings of feedback on this fin, such as the drift of its sensor. The option --feedback of
    the commands enables feedback."""
    settle_s: float = Field(default=5.0, ge=0, le=600)
    """Rest time before each log or experiment, during which the water calms down [s]."""


class EmulationConfig(Configuration):
    """Emulation of the drive and the sensor of a rig in simulated time, within each program that
    uses the rig."""

    seed: int = 0
    """Seed of the sensor noise."""
    tank: JsonObject = Field(default_factory=dict)
    """Tank around the fin, in the format of `softfin rig emulate --tank`; empty for the default
    tank."""


class RigConfig(RealFinConfig):
    """Configuration of one rig; values that depend on your hardware have no default."""

    bus: BusConfig | None = None
    """The CAN bus; required by drives on a CAN bus."""
    drive: Annotated[
        SerializeAsAny[DriveConfig],
        BeforeValidator(Chosen(partial(choose_config, DriveType, DriveConfig.DEFAULT_TYPE))),
    ]
    """The drive, selected by `type` (default: epos2)."""
    sensor: Annotated[
        SerializeAsAny[ForceSensorConfig],
        BeforeValidator(
            Chosen(partial(choose_config, ForceSensorType, ForceSensorConfig.DEFAULT_TYPE))
        ),
    ]
    """The force sensor, selected by `type` (default: axia80)."""
    safety: SafetyConfig
    """Safety limits; the current limits are required for a rig."""
    emulation: EmulationConfig | None = None
    """Emulation in simulated time; None for a real rig and for emulation in real time."""
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """File from which the configuration was read; None if it was built in Python."""
        return self._file

    @model_validator(mode="after")
    def _consistent(self) -> "RigConfig":
        if self.drive.NEEDS_BUS and self.bus is None:
            raise ValueError("bus: missing required key")
        if self.safety.current_peak_a is None:
            raise ValueError(
                "safety.current_peak_a and current_sustained_a are missing; set them to the peak "
                "and the maximum continuous current of the motor [A], from its data sheet"
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
        self.sensor.check_stale(self.safety.force_stale_s)
        return self


class Ros2Config(RealFinConfig):
    """Configuration of a fin behind ROS 2 topics."""

    topics: Ros2PlantConfig
    """Topics for the readings and commands of the fin."""


def load_rig(path: Path | None = None) -> RigConfig:
    """Load a rig file (default: rig.yaml); if it is invalid, raises RigError with the key, its
    value and the allowed values."""
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
