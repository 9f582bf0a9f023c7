"""The numbers that a calibration may change: names such as ``fin.length_m``, ranges, and points in the box they span.

A search moves in scaled coordinates: 0 is the low end of a parameter's range, 1 the high end, on a logarithmic scale
where both are positive and on a linear one elsewhere.
"""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.tank import TankConfig
from softfin.tank.calibration.recording import RecordingConfig

Range = tuple[float, float]
Ranges = dict[str, dict[str, Range | None]]
"""By group and name; None: not changed."""

Point = Float[np.ndarray, "parameters"]
"""In scaled coordinates, 0 .. 1."""

FREE: dict[str, Range] = {
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
"""What is fitted unless the configuration says otherwise.

Not span and root thickness: a ruler tells them, and no log can tell them from Young's modulus, drag and added mass. Not
the sensor's misalignment: all that turns with the shaft's zero turns, so one of three offsets must be known.
"""

_UNITS = {
    "_kg_m3": "kg/m3", "_kg_m2": "kg m2", "_rad_s2": "rad/s2", "_nm_rad": "N m/rad", "_rad_s": "rad/s", "_nm": "N m",
    "_rad": "rad", "_pa": "Pa", "_kg": "kg", "_c": "degC", "_m": "m", "_s": "s", "_n": "N",
}  # fmt: skip


class Parameter(NamedTuple):
    """One number, and the range in which it is sought."""

    name: str
    """Group and field: ``fin.length_m``."""
    low: float
    high: float

    @property
    def logarithmic(self) -> bool:
        """Whether its logarithm is what is searched."""
        return self.low > 0

    @property
    def unit(self) -> str:
        """Unit, which is the end of the parameter's name."""
        return next((unit for suffix, unit in _UNITS.items() if self.name.endswith(suffix)), "-")

    def scaled(self, value: float) -> float:
        """0 .. 1 within the range."""
        low, high, at = np.log([self.low, self.high, value]) if self.logarithmic else (self.low, self.high, value)
        return float((at - low) / (high - low))

    def value(self, scaled: float) -> float:
        """The inverse of `scaled`."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** scaled)
        return float(self.low + scaled * (self.high - self.low))

    def slope(self, scaled: float) -> float:
        """Return the derivative of the value by the scaled coordinate."""
        width = np.log(self.high / self.low) * self.value(scaled) if self.logarithmic else self.high - self.low
        return float(width)


def every_range(free: Mapping[str, Range] = FREE) -> Ranges:
    """All numbers of a tank and a recording by group, with the range of those that are free."""
    groups = {**_numbers(TankConfig()), "recording": list(RecordingConfig().model_dump())}
    return {group: {name: free.get(f"{group}.{name}") for name in names} for group, names in groups.items()}


def nested(ranges: Mapping[str, Any]) -> dict[str, Any]:
    """With ``fin.length_m: range`` written as ``fin: {length_m: range}``; both may stand side by side."""
    tree: dict[str, Any] = {}
    for name, value in ranges.items():
        group, dot, field = name.partition(".")
        tree[group] = {**tree.get(group, {}), **({field: value} if dot else dict(value))}
    return tree


def parameters_of(ranges: Mapping[str, Mapping[str, Range | None]]) -> Iterator[Parameter]:
    """Those that are free; raises ConfigurationError for an unknown name or a range that is none."""
    names_allowed = {f"{group}.{name}" for group, names in every_range().items() for name in names}
    for group, names in ranges.items():
        for field, limits in names.items():
            name = f"{group}.{field}"
            if name not in names_allowed:
                close = difflib.get_close_matches(name, sorted(names_allowed), n=1)
                hint = f"; did you mean {close[0]!r}?" if close else f"; the groups are {', '.join(every_range())}"
                raise ConfigurationError(f"parameters: there is no {name!r}{hint}")
            if limits is None:
                continue
            if not limits[0] < limits[1]:
                raise ConfigurationError(f"parameters.{name} = {list(limits)}: write [low, high] with low below high")
            yield Parameter(name, *map(float, limits))


class Space:
    """The box that the free parameters span, round a tank and a recording that give all other numbers."""

    def __init__(self, parameters: Sequence[Parameter], tank: TankConfig, recording: RecordingConfig) -> None:
        """Raise ConfigurationError where the box reaches beyond what is valid, or leaves out its starting point."""
        self.parameters = tuple(parameters)
        self.tank = tank
        self.recording = recording
        self.start = np.array([parameter.scaled(self._present(parameter)) for parameter in self.parameters])
        for parameter in self.parameters:
            for end in (parameter.low, parameter.high):
                self._built({parameter.name: end}, f"parameters.{parameter.name}")

    def values(self, point: Point) -> dict[str, float]:
        """By name."""
        return {p.name: p.value(float(at)) for p, at in zip(self.parameters, point, strict=True)}

    def configs(self, point: Point) -> tuple[TankConfig, RecordingConfig]:
        """The tank and the recording at a point."""
        return self._built(self.values(point), "calibration")

    def _built(self, values: Mapping[str, float], source: str) -> tuple[TankConfig, RecordingConfig]:
        trees = {**self.tank.model_dump(), "recording": self.recording.model_dump()}
        for name, value in values.items():
            group, field = name.split(".")
            trees[group][field] = value
        recording = RecordingConfig.build(trees.pop("recording"), source)
        return TankConfig.build(trees, source), recording

    def _present(self, parameter: Parameter) -> float:
        group, field = parameter.name.split(".")
        owner = self.recording if group == "recording" else getattr(self.tank, group)
        value = float(getattr(owner, field))
        if not parameter.low <= value <= parameter.high:
            path = parameter.name if group == "recording" else f"tank.{parameter.name}"
            raise ConfigurationError(
                f"parameters.{parameter.name} = [{parameter.low:g}, {parameter.high:g}]: the search starts at {path} = "
                f"{value:g}, which is outside; widen the range, or set {path}"
            )
        return value


def _numbers(config: Configuration) -> dict[str, list[str]]:
    groups = {name: value for name, value in config if isinstance(value, Configuration)}
    return {
        group: [name for name, value in values.model_dump().items() if isinstance(value, float)]
        for group, values in groups.items()
    }
