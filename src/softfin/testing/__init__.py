"""Conformance kit for softfin's tests and users' tests: `check_plant`, `check_surrogate`,
`check_drive` and `check_force_sensor` check a plant, surrogate, drive or force sensor against its
contract."""

from softfin.testing.devices import check_drive, check_force_sensor
from softfin.testing.plants import check_plant, check_surrogate

__all__ = ("check_drive", "check_force_sensor", "check_plant", "check_surrogate")
