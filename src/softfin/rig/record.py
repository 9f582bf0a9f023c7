"""The record of a rig, kept as JSON beside its file: rig.yaml has rig.record.json.

The file describes the setup of a rig. Its record contains what was measured on it: whether the
drive stops by itself if softfin dies, and where the sensor's zero was set. A rig that is built in
Python without a file has no record.
"""

import json
from datetime import datetime
from pathlib import Path

from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.storage import artifact as artifacts


class StopProof(Configuration):
    """The drive stopped by itself when softfin's heartbeats ended, the motor powered."""

    date: str
    """Date and time, as ISO 8601."""
    drive_serial: int | None
    """Serial number of the drive (0x1018.4); None if the drive does not report it."""
    heartbeat_s: float = Field(gt=0)
    """Setting under which it was proved [s]: `drive.heartbeat_s`."""
    host_node: int = Field(ge=1, le=127)
    """Setting under which it was proved: node number of softfin's heartbeats."""
    faulted_after_s: float = Field(ge=0)
    """Time from the last heartbeat to the drive's fault [s]."""


class ForceZero(Configuration):
    """The zero of the force sensor was set by softfin."""

    date: str
    """Date and time, as ISO 8601."""
    sensor_serial: str | None
    """Serial number of the sensor's calibration; None if the sensor does not report it."""
    ft_sequence: int = Field(ge=0)
    """Number of the sensor's record then, counted since its power-up: a smaller one later means
    that it restarted."""
    wall_s: float = Field(ge=0)
    """Time of day then [s since 1970]."""


class RigRecord(Configuration):
    """Everything that was measured on one rig."""

    stop_proof: StopProof | None = None
    """Proof that the drive stops by itself; None if it was never proved."""
    force_zero: ForceZero | None = None
    """Last zero of the force; None if softfin never set it."""


def date_and_time() -> str:
    """Return the present date and time, as ISO 8601."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def record_file(rig: Path) -> Path:
    """Return the file of a rig's record, which lies beside the rig's file."""
    return rig.with_suffix(".record.json")


def load_record(rig: Path | None) -> RigRecord:
    """Load the record of a rig's file; an empty one if there is none. Raises RigError if it cannot
    be used."""
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
    """Save the record of a rig's file; do nothing if the rig has no file. Raises RunError."""
    if rig is not None:
        artifacts.write_file(record_file(rig), record.model_dump_json(indent=2) + "\n")
