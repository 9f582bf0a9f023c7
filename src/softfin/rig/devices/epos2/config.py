"""Configuration of the drive, and conversion to the drive units: counts, rpm and rpm/s of the
motor."""

import math
from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from softfin.core.quantities import TICK_S
from softfin.rig.device import DriveConfig


class Epos2Config(DriveConfig):
    """An EPOS2 drive with its motor, gearbox and encoder."""

    NEEDS_BUS = True

    type: Literal["epos2"] = "epos2"
    """An EPOS2."""

    node: int = Field(ge=1, le=127)
    """Node number of the drive on the bus, set with its DIP switches or in EPOS Studio."""
    encoder_lines: int = Field(gt=0, le=2_500_000)
    """Encoder lines (pulses) per motor revolution; must match the setting in the drive."""
    gear_ratio: float = Field(gt=0)
    """Motor revolutions per revolution of the fin shaft; 1 without a gearbox."""
    zero_offset_rad: float = Field(0.0, ge=-math.pi, le=math.pi)
    """Fin angle at which the drive position is zero [rad]."""
    following_error_rad: float = Field(gt=0, le=1)
    """Following error at which the drive faults [rad]; no default. If it is too large, a blocked
    fin burns out its motor."""
    current_limit_a: float | None = Field(None, gt=0, le=10)
    """Maximum motor current, written to the drive [A]; None keeps the drive setting."""
    heartbeat_s: float = Field(0.2, ge=0.1, le=1)
    """Heartbeat timeout of both the drive and the host [s]: if the host hangs, the drive stops
    after this time."""
    host_node: int | None = Field(None, ge=1, le=127)
    """Node number that softfin uses for its heartbeat and SYNC; must be unique on the bus. None
    means 127 - node."""
    sync_s: float = Field(TICK_S, ge=0.001, le=0.1)
    """Period at which the drive is read [s]."""

    @property
    def summary(self) -> str:
        """The encoder and the gearbox."""
        return f"{self.encoder_lines} lines, gear {self.gear_ratio:g}"

    @property
    def host(self) -> int:
        """Return this program's node number, which must be unique: another program's heartbeats
        under it would keep this drive moving."""
        return 127 - self.node if self.host_node is None else self.host_node

    @model_validator(mode="after")
    def _fits(self) -> "Epos2Config":
        if self.host == 0:
            raise ValueError(
                "node 127 leaves no default for host_node; set host_node to a node number that "
                "is not in use"
            )
        if self.node == self.host:
            raise ValueError(
                f"node and host_node are both {self.node}; set host_node to a node number that is "
                "not in use"
            )
        # The drive's velocities are integers in rpm: at 0 rpm it would never reach a target.
        if Units.of(self).rpm(self.slowest_rad_s) == 0:
            raise ValueError(
                f"slowest_rad_s {self.slowest_rad_s:g} rounds to 0 rpm at the motor; increase it"
            )
        return self


class Units(NamedTuple):
    """Conversion between fin units (rad, rad/s, rad/s2) and drive units (counts, rpm, rpm/s)."""

    counts_per_rad: float
    rpm_per_rad_s: float
    direction: int
    zero: float
    """Fin angle at which the drive position is zero [rad]."""

    @classmethod
    def of(cls, config: Epos2Config) -> "Units":
        """Return the unit conversion for a drive."""
        # Motor turns per radian of the fin.
        turns_per_rad = config.gear_ratio / (2 * math.pi)
        # Quadrature: each encoder line gives four edges, and the drive counts all of them.
        counts_per_rad = turns_per_rad * 4 * config.encoder_lines
        return cls(counts_per_rad, 60 * turns_per_rad, config.direction, config.zero_offset_rad)

    def counts(self, angle: float) -> int:
        """Return the position [counts] at a fin angle [rad], rounded to the nearest count."""
        return self.direction * round((angle - self.zero) * self.counts_per_rad)

    def angle(self, counts: int) -> float:
        """Return the fin angle [rad] at a position [counts]."""
        return self.direction * counts / self.counts_per_rad + self.zero

    def rpm(self, velocity: float) -> int:
        """Return the motor speed [rpm] for a fin velocity [rad/s], or rpm/s for rad/s2; always
        positive."""
        return round(abs(velocity) * self.rpm_per_rad_s)

    def velocity(self, rpm: int) -> float:
        """Return the fin velocity [rad/s] for a motor velocity [rpm]."""
        return self.direction * rpm / self.rpm_per_rad_s
