"""Configuration of a Dynamixel, and conversion to servo units."""

import math
from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from softfin.core.dynamixel import (
    CENTER,
    MODELS,
    TICKS_PER_TURN,
    VELOCITY_UNIT_RPM,
    VOLTAGE_UNIT_V,
    Model,
)
from softfin.rig.device import DriveConfig
from softfin.rig.devices.dynamixel.protocol import ACCELERATION_UNIT_RPM_MIN, WATCHDOG_UNIT_S
from softfin.rig.safety import OVERSHOOT_RAD

MAX_ACCELERATION = 32_767
"""Maximum profile acceleration in the servo unit."""


class DynamixelConfig(DriveConfig):
    """A Dynamixel that turns the fin directly, without an additional gearbox."""

    ZERO_POWERS_MOTOR = False

    type: Literal["dynamixel"] = "dynamixel"
    """A Dynamixel X-series servo."""

    port: str
    """Serial port, e.g. /dev/ttyUSB0. Each fin needs a separate port, because any instruction on a
    port restarts the bus watchdogs of all servos on it."""
    model: Literal[tuple(MODELS)]  # type: ignore[valid-type]
    """Model; no default, because the unit of the current depends on it."""
    id: int = Field(ge=0, le=252)
    """ID of the servo."""
    baud: Literal[1_000_000, 2_000_000, 3_000_000, 4_000_000] = 1_000_000
    """Bits per second; a new servo is set to 57600, which is too slow for 100 Hz."""
    heartbeat_s: float = Field(0.1, ge=0.1, le=1)
    """Time without an instruction after which the servo stops by itself [s], in steps of 20 ms
    (Bus Watchdog)."""
    zero_needed: bool = True
    """Refuse to move until the fin has been zeroed once; the servo keeps the zero when it is
    switched off."""

    @property
    def summary(self) -> str:
        """Model and ID."""
        return f"{self.model}, ID {self.id}"

    @property
    def watchdog(self) -> int:
        """Value for the bus watchdog: one unit less than `heartbeat_s`, because the servo may react
        up to one unit late (unverified)."""
        return math.floor(self.heartbeat_s / WATCHDOG_UNIT_S + 1e-6) - 1

    @model_validator(mode="after")
    def _fits(self) -> "DynamixelConfig":
        if not self.acceleration_rad_s2 <= self.quick_stop_rad_s2:
            raise ValueError(
                f"quick_stop_rad_s2 {self.quick_stop_rad_s2:g} is below acceleration_rad_s2, so a "
                "stop would run past the target; increase it"
            )
        units = Units.of(self)
        if units.speed(self.slowest_rad_s) == 0:
            # The servo interprets 0 as "as fast as possible".
            raise ValueError(
                f"slowest_rad_s {self.slowest_rad_s:g} rounds to 0 in servo units; increase it"
            )
        for name in ("acceleration_rad_s2", "quick_stop_rad_s2"):
            value = getattr(self, name)
            if not 1 <= units.acceleration(value) <= MAX_ACCELERATION:
                raise ValueError(f"{name} {value:g} is outside the servo range")
        lowest, highest = position_range(self, OVERSHOOT_RAD)
        if lowest < 0 or highest >= TICKS_PER_TURN:
            raise ValueError(
                f"angle_min_rad and angle_max_rad must be within {math.pi - OVERSHOOT_RAD:.2f} rad "
                "of zero, because the position range of the servo ends after half a turn"
            )
        return self


class Units(NamedTuple):
    """Conversion between fin units and servo units."""

    model: Model
    direction: int

    @classmethod
    def of(cls, config: DynamixelConfig) -> "Units":
        """Return the unit conversion for a servo."""
        return cls(MODELS[config.model], config.direction)

    def position(self, angle: float) -> int:
        """Return the position at a fin angle [rad]."""
        return CENTER + self.direction * round(angle * TICKS_PER_TURN / (2 * math.pi))

    def angle(self, position: int) -> float:
        """Return the fin angle [rad] at a position."""
        return self.direction * (position - CENTER) * 2 * math.pi / TICKS_PER_TURN

    def speed(self, velocity: float) -> int:
        """Return the profile velocity for a fin velocity [rad/s]; always positive."""
        return round(abs(velocity) * 60 / (2 * math.pi) / VELOCITY_UNIT_RPM)

    def velocity(self, value: int) -> float:
        """Return the fin velocity [rad/s] for a present velocity."""
        return self.direction * value * VELOCITY_UNIT_RPM * 2 * math.pi / 60

    def acceleration(self, acceleration: float) -> int:
        """Return the profile acceleration for a fin acceleration [rad/s2]."""
        # rev/min2 = rad/s2 * 60^2 / 2 pi
        return round(acceleration * 3600 / (2 * math.pi) / ACCELERATION_UNIT_RPM_MIN)

    def current(self, value: int) -> float:
        """Return the current [A], positive in the positive direction of the fin."""
        return self.direction * value * self.model.current_unit_a

    def voltage(self, value: int) -> float:
        """Return the supply voltage [V]."""
        return value * VOLTAGE_UNIT_V


def position_range(config: DynamixelConfig, margin_rad: float = 0.0) -> tuple[int, int]:
    """Return the minimum and maximum position in the range of the fin, widened by a margin
    [rad]."""
    units = Units.of(config)
    ends = sorted(
        (
            units.position(config.angle_min_rad - margin_rad),
            units.position(config.angle_max_rad + margin_rad),
        )
    )
    return ends[0], ends[1]
