"""Configuration of a sensor that sends lines of text."""

from typing import Literal

from pydantic import Field, model_validator

from softfin.rig.machine import WRENCH_CHANNELS
from softfin.rig.streamed_sensor import StreamedSensorConfig

COUNTERS = {"count": 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Columns that number the lines (a line counter or the time since power-up) and their units [s]."""

Column = Literal[
    "force_x",
    "force_y",
    "force_z",
    "torque_x",
    "torque_y",
    "torque_z",
    "count",
    "time_ms",
    "time_us",
    "skip",
]


class LinesConfig(StreamedSensorConfig):
    """A sensor that sends one line per sample, e.g. an Arduino with load cells; set either `port`,
    or `address` and `udp_port`."""

    type: Literal["lines"] = "lines"
    """Lines of text."""
    columns: tuple[Column, ...] = Field(min_length=2, max_length=64)
    """Meaning of each column, e.g. ``[count, force_x, force_y]``: force and torque in sensor axes,
    a line counter or the time since power-up (as an unsigned 32-bit integer, so that losses and
    restarts are detected), or ``skip``."""
    port: str | None = None
    """Serial port, e.g. /dev/ttyACM0."""
    baud: int = Field(115_200, ge=1200, le=4_000_000)
    """Bits per second of the serial port."""
    address: str | None = None
    """IP address from which the sensor sends; records from other addresses are not used and cause a
    fault."""
    udp_port: int | None = Field(None, ge=1, le=65535)
    """UDP port of this computer to which the sensor sends."""
    separator: str = Field(",", min_length=1, max_length=1)
    """Character between two columns."""
    scale: dict[str, float] = Field(default_factory=dict)
    """Newtons (or newton metres) per unit, keyed by column name, e.g. ``force_x: -2.1e-5``; 1 for
    other columns."""

    @property
    def counter(self) -> str | None:
        """The column that numbers the lines; None if there is none."""
        return next((column for column in self.columns if column in COUNTERS), None)

    @model_validator(mode="after")
    def _fits(self) -> "LinesConfig":
        if (self.port is None) == (self.udp_port is None) or (
            (self.address is None) != (self.udp_port is None)
        ):
            raise ValueError("set either port, or both address and udp_port")
        named = [column for column in self.columns if column != "skip"]
        if len(set(named)) < len(named):
            raise ValueError(f"columns {', '.join(named)}: each may appear only once, except skip")
        if not {"force_x", "force_y"} <= set(named):
            raise ValueError("columns must contain force_x and force_y")
        if len(set(named) & COUNTERS.keys()) > 1:
            raise ValueError(f"columns may contain only one of {', '.join(COUNTERS)}")
        if wrong := sorted(set(self.scale) - (set(named) & set(WRENCH_CHANNELS))):
            raise ValueError(f"scale.{wrong[0]}: not a force or torque column")
        if not all(self.scale.values()):
            raise ValueError("scale must not be 0")
        return self
