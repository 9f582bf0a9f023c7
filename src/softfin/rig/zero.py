"""Zero the rig, at the word of a person: the fin's angle where it stands, the sensor's force as it is at rest."""

from typing import Any

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.config import RigConfig
from softfin.rig.rig import Rig

MOVING_N = 0.3
"""Standard deviation of the force beyond which the water, or somebody, still moves the fin [N]."""


def zero_force(config: RigConfig, seconds: float = 2.0, clock: Clock | None = None) -> dict[str, Any]:
    """Set the sensor's zero to what it feels; raises DeviceError where the fin is not at rest."""
    rig = Rig(config, clock)
    sensor = rig.sensor
    try:
        sensor.open()
        before = sensor.measured(seconds)
        worst = max(before.std[:3])
        if worst > MOVING_N:
            raise DeviceError(f"force varies by {worst:.2f} N (deviation): at most {MOVING_N:g} N; let the water rest")
        sensor.bias()
        after = sensor.measured(seconds)
        return {"force_before_n": _rounded(before.mean[:3]), "force_after_n": _rounded(after.mean[:3]),
                "noise_n": _rounded(after.std[:3])}  # fmt: skip
    finally:
        rig.close()


def zero_angle(config: RigConfig, clock: Clock | None = None) -> dict[str, Any]:
    """Make where the fin stands its angle 0 (or `drive.zero_offset_rad`); the motor is powered, nothing moves."""
    rig = Rig(config, clock)
    drive = rig.drive
    try:
        drive.open()
        before = drive.sync_and_read(0.02).angle
        drive.home_here()
        return {"angle_before_rad": round(before, 5), "angle_after_rad": round(drive.sync_and_read(0.02).angle, 5)}
    finally:
        rig.close()


def _rounded(values: tuple[float, ...]) -> list[float]:
    return [round(value, 4) for value in values]
