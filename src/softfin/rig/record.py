"""The record of a rig, stored as JSON next to the rig file: rig.record.json for rig.yaml.

The file describes the setup of a rig. The record contains the results of tests on the rig: whether
the drive stops by itself if softfin dies, and the sensor zero. A rig built in Python without a file
has no record.
"""

import json
from datetime import datetime
from pathlib import Path

from pydantic import ConfigDict, Field, JsonValue

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.storage import artifact as artifacts


class MovingProof(Configuration):
    """Result of killing and suspending a program that swings the fin."""

    # Records of earlier versions have more fields.
    model_config = ConfigDict(extra="ignore")

    deaths: int = Field(gt=0)
    """Number of times that the program was killed or suspended."""
    velocity_rad_s: float = Field(gt=0)
    """Velocity of the swing [rad/s]."""
    way_median_rad: float
    way_worst_rad: float
    """Angle by which the fin turned after each death [rad]."""

    @property
    def text(self) -> str:
        """Short summary of the result."""
        return (
            f"the fin turned {self.way_median_rad:.2f} rad, at most {self.way_worst_rad:.2f} rad, "
            f"after softfin died ({self.deaths} times, at {self.velocity_rad_s:.2f} rad/s)"
        )


class StopProof(Configuration):
    """Proof that the drive stopped by itself when the heartbeats from softfin ended while the motor
    was powered."""

    date: str
    """Date and time, as ISO 8601."""
    drive: dict[str, int | str | None]
    """`identity` of the drive during the test."""
    heartbeat_s: float = Field(gt=0)
    """Value of `drive.heartbeat_s` during the test [s]."""
    host_node: int | None = Field(ge=1, le=127)
    """Node number of the heartbeats from softfin during the test; None if the bus has no such
    numbers."""
    faulted_after_s: float = Field(ge=0)
    """Time from the last heartbeat to the fault of the drive [s]."""
    moving: MovingProof | None = None
    """Result of the same test with a moving fin; None if it has not been run."""


class ForceZero(Configuration):
    """Record of the latest force sensor zero set by softfin."""

    date: str
    """Date and time, as ISO 8601."""
    wrench: tuple[float, float, float, float, float, float]
    """Wrench that softfin subtracts, in the sensor axes [N, N m]."""
    sensor: dict[str, JsonValue]
    """Configuration of the sensor without its address, and its `identity`."""


class RigRecord(Configuration):
    """All test results of one rig."""

    stop_proof: StopProof | None = None
    """Proof that the drive stops by itself; None if there is no proof."""
    force_zero: ForceZero | None = None
    """Latest force zero; None if softfin has never set it."""


def date_and_time() -> str:
    """Return the current date and time in ISO 8601 format."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def record_file(rig: Path) -> Path:
    """Return the path of a rig record, next to the rig file."""
    return rig.with_suffix(".record.json")


def load_record(rig: Path | None) -> RigRecord:
    """Load the record for a rig file, or return an empty record if there is none; raises RigError
    if the record is invalid."""
    if rig is None or not record_file(rig).exists():
        return RigRecord()
    file = record_file(rig)
    try:
        return RigRecord.build(json.loads(file.read_bytes()), str(file))
    except (OSError, ValueError, RecursionError, ConfigurationError) as error:
        raise RigError(
            f"{file}: not the record of a rig ({error}); remove it, then prove and zero the rig "
            "again"
        ) from None


def save_record(rig: Path | None, record: RigRecord) -> None:
    """Save the record for a rig file, unless the rig has no file; raises RunError if the record
    cannot be written."""
    if rig is not None:
        artifacts.write_file(record_file(rig), record.model_dump_json(indent=2) + "\n")
