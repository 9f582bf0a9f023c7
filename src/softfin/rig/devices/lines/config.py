"""Configuration of a sensor that sends lines of text."""

import math
from typing import Literal

from pydantic import Field, model_validator

from softfin.core.quantities import RATE_HZ
from softfin.rig.device import ForceSensorConfig
from softfin.rig.filter import BRIDGED_S, design

WRENCH_CHANNELS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Columns with the wrench, in the order of a wrench."""

COUNTERS = {"count": 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Columns that number the lines: a counter of lines, or the time since power-up, with its unit
[s]."""

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


class LinesConfig(ForceSensorConfig):
    """A sensor that sends one line per sample, e.g. an Arduino with load cells; set either `port`,
    or `address` and `udp_port`."""

    type: Literal["lines"] = "lines"
    """Lines of text."""
    columns: tuple[Column, ...] = Field(min_length=2, max_length=64)
    """Meaning of each column, e.g. ``[count, force_x, force_y]``: force and torque in the sensor's
    axes, a counter of lines or a time since power-up (as unsigned 32-bit integer, so that losses
    and restarts are noticed), or ``skip``."""
    rate_hz: float = Field(ge=10, le=1000)
    """Lines per second; softfin measures the rate when it opens the sensor and rejects a deviation
    of more than 10%."""
    filter_delay_s: float = Field(ge=0, le=0.5)
    """Delay of the sensor's own filter [s], by which softfin corrects the time of the force; no
    default, because it depends on the converter and its settings."""
    port: str | None = None
    """Serial port, e.g. /dev/ttyACM0."""
    baud: int = Field(115_200, ge=1200, le=4_000_000)
    """Bits per second of the serial port."""
    address: str | None = None
    """IP address from which the sensor sends; records from others are not used, but are a fault."""
    udp_port: int | None = Field(None, ge=1, le=65535)
    """UDP port of this computer to which the sensor sends."""
    separator: str = Field(",", min_length=1, max_length=1)
    """Character between two columns."""
    scale: dict[str, float] = Field(default_factory=dict)
    """Newtons (or newton metres) per unit of a column, by its name, e.g. ``force_x: -2.1e-5``;
    1 for other columns."""
    cutoff_hz: float = Field(30.0, ge=10, le=40)
    """Cut-off frequency of the anti-alias filter (gain 1/2) [Hz]; not used at 100 lines per second
    or fewer."""

    @property
    def is_filtered(self) -> bool:
        """Whether softfin filters the lines; at a rate below that of the log there is nothing to
        filter."""
        return self.rate_hz > RATE_HZ

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
            raise ValueError(f"scale.{wrong[0]}: not a column with a force or torque")
        if not all(self.scale.values()):
            raise ValueError("scale must not be 0")
        return self

    def check_stale(self, force_stale_s: float) -> None:
        """Raise ValueError if the force is usually older than a limit on its age [s]."""
        filter_s = 0.0
        if self.is_filtered:
            filter_s = len(design(self.rate_hz, self.cutoff_hz)) // 2 / self.rate_hz
        # As for other sensors, the filter may have to refill; and two lines may be lost.
        needed = self.filter_delay_s + 3 * filter_s + max(2 * BRIDGED_S, 3 / self.rate_hz)
        if force_stale_s < needed:
            raise ValueError(
                f"safety.force_stale_s = {force_stale_s:g}: at {self.rate_hz:g} lines per second "
                f"and with a delay of {self.filter_delay_s + filter_s:.3f} s, the force may be "
                f"older; use {math.ceil(100 * needed) / 100:.2f} or more, or a faster sensor"
            )
