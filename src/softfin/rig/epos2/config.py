"""Configuration of the drive and of the bus to it, and the units between them: counts, rpm and
rpm/s of the motor."""

import math
from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from softfin.core.configuration import Configuration
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Limits

MAX_BRAKE_S = 0.5
"""Longest quick stop from the highest velocity [s]; the wait for a longer one would time out."""


class BusConfig(Configuration):
    """A CAN bus as python-can names it."""

    interface: str
    """Interface of the adapter: socketcan, pcan, kvaser, slcan, socketcand, virtual ..; no
    default."""
    channel: str
    """Channel of the interface, such as can0; no default."""
    bitrate: int = Field(1_000_000, gt=0, le=1_000_000)
    """Bitrate [bit/s]; the factory setting of an EPOS2 is 1 Mbit/s. SocketCAN uses the bitrate that
    ``ip link`` set."""
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)
    """Further options of the interface, such as host and port of socketcand."""


class Epos2Config(Configuration):
    """An EPOS2 with its motor, gear and encoder."""

    node: int = Field(ge=1, le=127)
    """Number of the drive on the bus, as its switches or EPOS Studio set it."""
    encoder_lines: int = Field(gt=0, le=2_500_000)
    """Lines (pulses) of the encoder in one turn of the motor; compared with the drive's own
    setting."""
    gear_ratio: float = Field(gt=0)
    """Turns of the motor in one turn of the fin; 1 without a gear."""
    direction: Literal[1, -1] = 1
    """-1 where positive counts turn the fin to negative angles."""
    zero_offset_rad: float = Field(0.0, ge=-math.pi, le=math.pi)
    """Angle of the fin where the drive counts zero [rad]."""
    angle_min_rad: float = PAPER_LIMITS.angle_min
    """Smallest angle that the drive itself allows [rad]; the paper's, Sec. III-A."""
    angle_max_rad: float = PAPER_LIMITS.angle_max
    """Largest angle that the drive itself allows [rad]; the paper's, Sec. III-A."""
    slowest_rad_s: float = Field(PAPER_LIMITS.velocity_min, gt=0)
    """Lowest profile velocity of a command [rad/s]; the paper's, Sec. III-A."""
    fastest_rad_s: float = Field(PAPER_LIMITS.velocity_max, gt=0)
    """Highest profile velocity, which the drive enforces [rad/s]; the paper's, Sec. III-A."""
    acceleration_rad_s2: float = Field(gt=0)
    """Acceleration and deceleration of the profile [rad/s2]; no default: it follows from motor,
    gear and fin."""
    quick_stop_rad_s2: float = Field(gt=0)
    """Deceleration of a quick stop [rad/s2]; no default: as much as the fin's mount can take."""
    following_error_rad: float = Field(gt=0, le=1)
    """Distance from the profile at which the drive faults [rad]; no default: if it is too large, a
    blocked fin burns out its motor."""
    current_limit_a: float | None = Field(None, gt=0, le=10)
    """Maximum motor current, written to the drive [A]; None keeps the drive's own setting."""
    heartbeat_s: float = Field(0.2, ge=0.1, le=1)
    """Silence after which drive and host consider each other dead [s]: if the host hangs, the drive
    stops this much later."""
    host_node: int | None = Field(None, ge=1, le=127)
    """Node number of this program's heartbeat and SYNC, unique on the bus; None: 127 - node."""
    sync_s: float = Field(TICK_S, ge=0.001, le=0.1)
    """Period of the loop that reads the drive [s]."""
    zero_needed: bool = True
    """Refuse to move until the fin is zeroed after each power-up of the drive; false only for an
    absolute encoder."""

    @property
    def host(self) -> int:
        """Node number of this program: its own, so that no other program's heartbeats keep this
        drive moving."""
        return 127 - self.node if self.host_node is None else self.host_node

    @property
    def limits(self) -> Limits:
        """Range of the commands."""
        return Limits(
            self.angle_min_rad, self.angle_max_rad, self.slowest_rad_s, self.fastest_rad_s
        )

    @model_validator(mode="after")
    def _fits(self) -> "Epos2Config":
        if problem := self.limits.problem(one_velocity=True):
            raise ValueError(problem)
        if self.host == 0:
            raise ValueError(
                "node 127 leaves no number for the host; set host_node to one that no device has"
            )
        if self.node == self.host:
            raise ValueError(
                f"node and host_node are both {self.node}; set host_node to a number that no "
                "device has"
            )
        braking = self.fastest_rad_s / self.quick_stop_rad_s2
        if braking > MAX_BRAKE_S:
            raise ValueError(
                f"quick_stop_rad_s2 {self.quick_stop_rad_s2:g} takes {braking:.1f} s to stop from "
                f"fastest_rad_s: at most {MAX_BRAKE_S:g} s; use "
                f"{self.fastest_rad_s / MAX_BRAKE_S:.1f} or more"
            )
        if Units.of(self).rpm(self.slowest_rad_s) == 0:
            raise ValueError(
                f"slowest_rad_s {self.slowest_rad_s:g} is less than 1 rpm of the motor; raise it"
            )
        return self


class Units(NamedTuple):
    """Conversion of the fin's angle to the drive's counts, rpm and rpm/s, and back."""

    counts_per_rad: float
    rpm_per_rad_s: float
    direction: int
    zero: float
    """Angle of the fin where the drive counts zero [rad]."""

    @classmethod
    def of(cls, config: Epos2Config) -> "Units":
        """Units of a drive."""
        turns_per_rad = config.gear_ratio / (2 * math.pi)
        # Quadrature: every line of the encoder gives four edges.
        counts_per_rad = turns_per_rad * 4 * config.encoder_lines
        return cls(counts_per_rad, 60 * turns_per_rad, config.direction, config.zero_offset_rad)

    def counts(self, angle: float) -> int:
        """Position [counts] at an angle [rad], to the nearest count."""
        return self.direction * round((angle - self.zero) * self.counts_per_rad)

    def angle(self, counts: int) -> float:
        """Angle [rad] at a position [counts]."""
        return self.direction * counts / self.counts_per_rad + self.zero

    def rpm(self, velocity: float) -> int:
        """Speed of the motor [rpm], or its change in a second, for a velocity of the fin [rad/s];
        its size."""
        return round(abs(velocity) * self.rpm_per_rad_s)

    def velocity(self, rpm: int) -> float:
        """Velocity of the fin [rad/s] for one of the motor [rpm]."""
        return self.direction * rpm / self.rpm_per_rad_s
