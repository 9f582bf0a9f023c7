"""Configuration of a calibration: parameters, data and search.

Each free parameter has a name, e.g. ``fin.length_m``, and a range. Searches use scaled coordinates:
0 is the lower end of the range and 1 the upper end. The scale is logarithmic if both ends are
positive, otherwise linear.
"""

import difflib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from softfin.core.choices import CalibratePreset
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.tank import TankConfig

CalibrationRange = tuple[float, float]
Ranges = dict[str, dict[str, CalibrationRange | None]]
"""Range of each number by group and name; None keeps the number fixed."""

CalibrationPoint = Float[np.ndarray, "parameters"]
"""Scaled coordinates of the parameters, 0 to 1."""

BLOCK_S = 2.0
"""Length of the time blocks whose errors are assumed independent in the standard errors."""

FREE: dict[str, CalibrationRange] = {
    "drive.acceleration_rad_s2": (5.0, 500.0),
    "drive.dead_time_s": (0.0, 0.15),
    "drive.lag_s": (0.001, 0.3),
    "fin.length_m": (0.08, 0.4),
    "fin.root_length_m": (0.0, 0.08),
    "fin.tip_span_ratio": (0.3, 3.0),
    "fin.tip_thickness_ratio": (0.1, 1.2),
    "fin.youngs_modulus_pa": (3e5, 3e7),
    "fin.damping_s": (0.001, 0.2),
    "water.added_mass_coefficient": (0.1, 4.0),
    "water.drag_coefficient": (0.5, 30.0),
    "water.friction_coefficient": (0.3, 300.0),
    "water.tip_coefficient": (0.0, 2.0),
    "water.stream_mass_kg": (0.5, 50.0),
    "water.stream_decay_s": (0.0, 3.0),
    "recording.angle_gain": (0.5, 1.5),
    "recording.angle_offset_rad": (-0.2, 0.2),
    "recording.velocity_factor": (0.5, 15.0),
    "recording.velocity_limit_rad_s": (2.0, 15.0),
    "recording.reading_gain": (0.5, 1.5),
    "recording.reading_offset_rad": (-0.2, 0.2),
    "recording.force_x_n": (-1.0, 1.0),
    "recording.force_y_n": (-1.0, 1.0),
}
"""Ranges of the parameters that are fitted by default.

Span and root thickness are excluded, because they can be measured with a ruler and no log can
separate them from Young's modulus, drag and added mass. The sensor misalignment is excluded,
because it cannot be separated from the two shaft-angle offsets.
"""

# The order matters, because the first match is used: "_rad_s" must precede "_s".
_UNITS = {
    "_kg_m3": "kg/m3",
    "_kg_m2": "kg m2",
    "_rad_s2": "rad/s2",
    "_nm_rad": "N m/rad",
    "_rad_s": "rad/s",
    "_nm": "N m",
    "_rad": "rad",
    "_pa": "Pa",
    "_kg": "kg",
    "_c": "degC",
    "_m": "m",
    "_s": "s",
    "_n": "N",
}


class RecordingConfig(Configuration):
    """Gains and offsets between the commands and readings of a log and those of a tank."""

    angle_gain: float = Field(1.0, gt=0)
    """Target angle divided by commanded angle [-]."""
    angle_offset_rad: float = 0.0
    """Target angle for a command of 0 [rad]."""
    velocity_factor: float = Field(1.0, gt=0)
    """Profile velocity divided by commanded velocity [-]; depends on the unit of the log."""
    velocity_limit_rad_s: float = Field(12.5, gt=0)
    """Maximum profile velocity of the recorded drive [rad/s]."""
    reading_gain: float = Field(1.0, gt=0)
    """Angle in the log divided by the angle of the shaft [-]."""
    reading_offset_rad: float = 0.0
    """Angle in the log when the shaft is at 0 [rad]: the zero of the encoder."""
    force_x_n: float = 0.0
    """Reading of the force sensor along x at zero force [N]."""
    force_y_n: float = 0.0
    """Reading of the force sensor along y at zero force [N]."""


class Parameter(NamedTuple):
    """A number to fit, and its range."""

    name: str
    """Group and field, e.g. ``fin.length_m``."""
    low: float
    """Lower end of the range, in the unit of the parameter."""
    high: float
    """Upper end of the range, in the unit of the parameter."""

    @property
    def unit(self) -> str:
        """Unit, from the end of the parameter's name."""
        return next((unit for suffix, unit in _UNITS.items() if self.name.endswith(suffix)), "-")

    def scaled(self, value: float) -> float:
        """Return the scaled coordinate of a value; 0 to 1 within the range."""
        numbers = np.array([self.low, self.high, value])
        low, high, at = np.log(numbers) if self.low > 0 else numbers
        return float((at - low) / (high - low))

    def value(self, scaled: float) -> float:
        """Return the value at a scaled coordinate; the inverse of `scaled`."""
        if self.low > 0:
            # log(value) = log(low) + scaled * log(high / low)
            return float(self.low * (self.high / self.low) ** scaled)
        return float(self.low + scaled * (self.high - self.low))

    def slope(self, scaled: float) -> float:
        """Return the derivative of the value with respect to the scaled coordinate."""
        if self.low > 0:
            return float(np.log(self.high / self.low) * self.value(scaled))
        return self.high - self.low


def every_range(free: Mapping[str, CalibrationRange] = FREE) -> Ranges:
    """Return all numbers of a tank and a recording by group; those not in `free` have no range."""
    ranges: Ranges = {}
    for group, values in (*TankConfig(), ("recording", RecordingConfig())):
        # `steps_per_tick` is a field of the tank itself, not a group.
        if not isinstance(values, Configuration):
            continue
        ranges[group] = {}
        for name, value in values:
            if isinstance(value, float):
                ranges[group][name] = free.get(f"{group}.{name}")
    return ranges


def list_parameters(ranges: Ranges) -> list[Parameter]:
    """Return the free parameters.

    Raises:
        ConfigurationError: a name is unknown, or a range is not ascending.
    """
    allowed = _by_full_name(every_range())
    parameters = []
    for name, limits in _by_full_name(ranges).items():
        if name not in allowed:
            (close,) = difflib.get_close_matches(name, allowed, n=1, cutoff=0)
            raise ConfigurationError(
                f"parameters: unknown parameter {name!r}; did you mean {close!r}?"
            )
        if limits is None:
            continue
        if not limits[0] < limits[1]:
            raise ConfigurationError(
                f"parameters.{name} = {list(limits)}: use [low, high] with low less than high"
            )
        parameters.append(Parameter(name, float(limits[0]), float(limits[1])))
    return parameters


def _by_full_name(ranges: Ranges) -> dict[str, CalibrationRange | None]:
    found = {}
    for group, names in ranges.items():
        for name, limits in names.items():
            found[f"{group}.{name}"] = limits
    return found


class CalibrateConfig(Configuration):
    """Configuration of a calibration."""

    parameters: Ranges = Field(default_factory=every_range, validate_default=True)
    """Range [low, high] of each number to fit; null keeps the value in `tank` or `recording`."""
    tank: TankConfig = TankConfig()
    """Initial tank; it also contains the values that are not fitted."""
    recording: RecordingConfig = RecordingConfig()
    """Initial recording; it also contains the values that are not fitted."""
    evaluations: int = Field(4000, ge=0)
    """Number of tanks simulated in the global search (CMA-ES); 0 for a local search only."""
    step: float = Field(0.1, gt=0, le=1)
    """Standard deviation of the first generation, as a fraction of each range."""
    iterations: int = Field(12, ge=1)
    """Maximum number of steps of the local search (trust region). It ends earlier if a step
    improves the loss by less than 1e-6 of its value."""
    segments: int = Field(24, ge=2)
    """Maximum number of segments cut from the training logs."""
    test_segments: int = Field(12, ge=1)
    """Maximum number of segments cut from the test logs."""
    segment_s: float = Field(12.0, ge=0.1)
    """Length of each segment [s]."""
    warm_up_s: float = Field(2.0, ge=0)
    """Part of each segment that is simulated but not compared [s]; must be longer than a stroke,
    because the simulation starts at rest and the log may start mid-stroke."""
    velocity_rad_s: CalibrationRange | None = None
    """Range of the velocities commanded to a plant [rad/s]; null for its limits. Logs contain
    their own commands."""

    @model_validator(mode="after")
    def _long_enough(self) -> "CalibrateConfig":
        shortest_s = self.warm_up_s + BLOCK_S
        if self.segment_s < shortest_s:
            raise ValueError(
                f"segment_s = {self.segment_s:g} must be at least warm_up_s + {BLOCK_S:g} = "
                f"{shortest_s:g}"
            )
        return self


_MOST_INFORMATIVE = (
    "drive.acceleration_rad_s2",
    "drive.lag_s",
    "fin.length_m",
    "fin.youngs_modulus_pa",
    "water.added_mass_coefficient",
    "water.drag_coefficient",
)

CALIBRATE_PRESETS: dict[CalibratePreset, CalibrateConfig] = {
    "full": CalibrateConfig(),
    "quick": CalibrateConfig(
        parameters=every_range({name: FREE[name] for name in _MOST_INFORMATIVE}),
        evaluations=800,
        iterations=8,
        segments=12,
        test_segments=6,
    ),
}
"""Presets: ``full`` fits fin, water, drive and recording. ``quick`` fits only the most informative
parameters, without the recording, and takes about a minute."""
