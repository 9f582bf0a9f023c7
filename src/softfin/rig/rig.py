"""The rig as a `Machine`: one drive and one force sensor, both read at each tick."""

from collections.abc import Callable

from softfin.core.errors import RigError
from softfin.core.json_object import JsonObject
from softfin.rig import force_zero
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import RigConfig
from softfin.rig.device import Drive
from softfin.rig.device_type import DriveType, ForceSensorType
from softfin.rig.devices.registry import find_device
from softfin.rig.force_zero import check_force_zero
from softfin.rig.machine import Sample, Target
from softfin.rig.prove import check_proof


class Rig:
    """A rig that implements the `Machine` protocol."""

    def __init__(self, config: RigConfig, clock: Computer = COMPUTER) -> None:
        self.config = config
        self.clock = clock
        drive = config.drive
        self.name = f"rig of {config.fin}"
        self.limits = drive.limits
        self.torque_constant_nm_a = drive.torque_constant_nm_a
        self.motor = drive.motor
        # Stop immediately on a drive fault, without waiting for the next tick.
        self.drive: Drive = find_device(DriveType, drive.type).make(
            drive, config.bus, self.clock, lambda _: self.stop()
        )
        self.sensor = find_device(ForceSensorType, config.sensor.type).make(
            config.sensor, self.clock
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes from the sensor and on devices that cannot be locked."""
        lock_notes = (self.drive.device_lock.note, self.sensor.device_lock.note)
        return (*self.sensor.notes(), *(note for note in lock_notes if note is not None))

    def check_ready(self) -> None:
        """Raise RigError unless there is a proof that the drive stops by itself if softfin dies;
        the drive must be open."""
        check_proof(self.config, self.drive)

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on; None if the motor is confirmed to be off."""
        return self.drive.stop_unconfirmed

    def open(self) -> None:
        """Connect to both devices and configure the drive; the motor stays off.

        Raises RigError if the force zero is from a different sensor or different settings.
        """
        # The drive comes first: if a second program is using the rig, this call fails before it
        # takes over the sensor stream of that program.
        self.drive.open()
        try:
            self.sensor.open()
            check_force_zero(self.sensor, self.config)
        except BaseException:
            self.drive.close()
            self.sensor.close()
            raise

    def read(self) -> Sample:
        """Read the drive now, and return its values with the latest received force."""
        drive = self.drive.read()
        force = self.sensor.read()
        return Sample(
            **drive._asdict(),
            complaints=(*self.drive.complaints(), *self.sensor.complaints()),
            **force._asdict(),
        )

    def enable(self) -> None:
        """Power the motor, which holds its position."""
        # The first tick with power must check a current force, so keep reading the sensor while the
        # drive is being enabled.
        self.drive.enable(meanwhile=self.sensor.keep_up)

    def command(self, target: Target) -> None:
        """Send a new setpoint, which takes effect immediately."""
        self.drive.command(target)

    def stop(self) -> None:
        """Quick-stop, then disable the voltage."""
        self.drive.stop()

    def close(self) -> None:
        """Stop and release both devices."""
        self.drive.close()
        self.sensor.close()

    def counters(self) -> dict[str, int]:
        """Return the counters of both devices."""
        counted = {
            f"drive_{name.replace(' ', '_')}": count
            for name, count in self.drive.counters().items()
        }
        return counted | self.sensor.counters()


def zero_force(rig: Rig, seconds: float = 2.0) -> JsonObject:
    """Set the force zero to the force at rest; raises DeviceError if the fin is not at rest. The
    rig is closed afterwards."""
    try:
        rig.sensor.open()
        return force_zero.zero_force(rig.sensor, rig.config, seconds)
    finally:
        rig.close()


def zero_angle(rig: Rig, confirm: Callable[[Rig], object] = lambda rig: None) -> JsonObject:
    """Set the fin's current angle to `drive.zero_offset_rad` (default 0); nothing moves.

    `confirm` is called after the drive is opened and before its motor may be powered. The result
    contains `own_stop` if there is no valid proof that the drive stops by itself with the new zero.
    The rig is closed afterwards.
    """
    drive = rig.drive
    try:
        drive.open()
        confirm(rig)
        before = drive.read_angle()
        drive.zero()
        result: JsonObject = {
            "angle_before_rad": round(before, 5),
            "angle_after_rad": round(drive.read_angle(), 5),
        }
        try:
            check_proof(rig.config, drive)
        except RigError as error:
            result["own_stop"] = str(error)
        return result
    finally:
        rig.close()
