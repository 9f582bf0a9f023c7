"""Interface of a rig drive, and the configurations and readings of drives and force sensors.

A device is a folder in `rig/devices`, or your own package with an entry point in the group
`softfin.devices`. It consists of a configuration and a class that implements `Drive` or, for a
force sensor, `softfin.rig.streamed_sensor.RecordSource`. A `DriveType` or `ForceSensorType` from
`softfin.rig.device_type` combines the two. `softfin.testing.check_drive` and `check_force_sensor`
test an implementation.

All times are from the `clock` that is passed to the device [s]. All calls come from one thread at a
time, except that any thread may call `Drive.stop`.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import ClassVar, Literal, NamedTuple, Protocol

from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import DeviceError, SoftfinError
from softfin.core.json_object import JsonObject
from softfin.core.power import Motor
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Target, Wrench

MARKS = {"well": "ok", "note": "note", "wrong": "WRONG"}
"""Printed form of each result state."""
MAX_BRAKE_S = 0.5
"""Maximum braking time from the highest velocity [s]; softfin does not wait any longer."""


class RefusedError(DeviceError):
    """A drive refused an instruction; `code` is the error number in its protocol."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class CheckResult(NamedTuple):
    """One line of the table printed by `softfin rig check`."""

    what: str
    state: Literal["well", "note", "wrong"]
    text: str

    def __str__(self) -> str:
        return f"{MARKS[self.state]:>6}  {self.what:14} {self.text}"


def failing(
    results: Iterable[CheckResult], error: Callable[[str], SoftfinError]
) -> Iterator[CheckResult]:
    """Yield each result as soon as it is available, then raise an error with the names of the
    failed checks."""
    failed = []
    for result in results:
        if result.state == "wrong":
            failed.append(result.what)
        yield result
    if failed:
        raise error(f"failed: {', '.join(failed)}")


class DeviceConfig(Configuration):
    """Configuration of a device in a rig file; `type` selects the device."""

    DEFAULT_TYPE: ClassVar[str]
    """Type of a device without the key `type`."""

    type: str
    """Name of the device type."""


def is_address(field: str) -> bool:
    """Return whether a configuration field of a device only defines its address, which may change
    at any time; other fields affect the readings or the motion."""
    return field in ("address", "port", "connection") or field.endswith("_port")


def drop_address(device: JsonObject) -> JsonObject:
    """Return the configuration of a device without the address fields."""
    return {name: value for name, value in device.items() if not is_address(name)}


class DriveConfig(DeviceConfig):
    """Settings that softfin requires for every drive."""

    DEFAULT_TYPE = "epos2"
    NEEDS_BUS: ClassVar[bool] = False
    """Whether this drive needs a CAN bus in the rig file."""
    ZERO_POWERS_MOTOR: ClassVar[bool] = True
    """Whether `Drive.zero` powers the motor and therefore needs a proof that the drive stops by
    itself."""

    angle_min_rad: float = PAPER_LIMITS.angle_min
    """Minimum fin angle, enforced by the drive [rad]; the default is from the paper, Sec. III-A."""
    angle_max_rad: float = PAPER_LIMITS.angle_max
    """Maximum fin angle, enforced by the drive [rad]; the default is from the paper, Sec. III-A."""
    slowest_rad_s: float = Field(PAPER_LIMITS.velocity_min, gt=0)
    """Minimum profile velocity of a command [rad/s]; the default is from the paper, Sec. III-A."""
    fastest_rad_s: float = Field(PAPER_LIMITS.velocity_max, gt=0)
    """Maximum profile velocity, enforced by the drive [rad/s]; the default is from the paper, Sec.
    III-A."""
    acceleration_rad_s2: float = Field(gt=0)
    """Profile acceleration and deceleration [rad/s2]; no default, because it depends on the motor,
    gearbox and fin."""
    quick_stop_rad_s2: float = Field(gt=0)
    """Deceleration of a stop [rad/s2]; no default, because it depends on the load that the fin
    mount can withstand."""
    direction: Literal[1, -1] = 1
    """-1 if the positive direction of the drive corresponds to negative fin angles."""
    torque_constant_nm_a: PositiveFloat | None = None
    """Torque at the output shaft per ampere of motor current [N m/A], including the gear ratio and
    the efficiency of the gear; None if unknown. Feedback from torque requires it if there is no
    torque sensor."""
    gear_efficiency: float = Field(1.0, gt=0, le=1)
    """Efficiency of the gear that `torque_constant_nm_a` includes [-]."""
    winding_ohm: PositiveFloat | None = None
    """Winding resistance of the motor from phase to phase [ohm]; None if unknown. Electrical power
    requires it, and `torque_constant_nm_a`."""
    heartbeat_s: float = Field(0.2, ge=0.1, le=1)
    """Time without a message from softfin after which the drive stops by itself [s]."""
    zero_needed: bool = True
    """Refuse to move until the fin has been zeroed after each power-up of the drive; set this to
    false only for an absolute encoder."""

    @property
    def motor(self) -> Motor | None:
        """The motor and gear; None if a value is unknown."""
        if self.torque_constant_nm_a is None or self.winding_ohm is None:
            return None
        without_losses = self.torque_constant_nm_a / self.gear_efficiency
        return Motor(without_losses, self.winding_ohm, self.gear_efficiency)

    @property
    def limits(self) -> Limits:
        """Command limits."""
        return Limits(
            self.angle_min_rad, self.angle_max_rad, self.slowest_rad_s, self.fastest_rad_s
        )

    @property
    def summary(self) -> str:
        """Short summary of the settings to compare with the device."""
        return self.type

    @property
    def host(self) -> int | None:
        """Number of this program on the bus of the drive; None if the bus has no such numbers."""
        return None

    @model_validator(mode="after")
    def _limits_fit(self) -> "DriveConfig":
        if problem := self.limits.problem():
            raise ValueError(problem)
        braking_s = self.fastest_rad_s / self.quick_stop_rad_s2
        if braking_s > MAX_BRAKE_S:
            raise ValueError(
                f"quick_stop_rad_s2 {self.quick_stop_rad_s2:g} needs {braking_s:.1f} s to stop "
                f"from fastest_rad_s, but at most {MAX_BRAKE_S:g} s is allowed; use "
                f"{self.fastest_rad_s / MAX_BRAKE_S:.1f} or more"
            )
        return self


class ForceSensorConfig(DeviceConfig):
    """Settings that softfin requires for every force sensor."""

    DEFAULT_TYPE = "axia80"

    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """Sensor axes along softfin's +x (forward thrust on the robot) and +y, e.g. ``y,-x``; z follows
    from the right-hand rule. No default, because the axes depend on how the sensor is mounted."""

    def check_stale(self, force_stale_s: float) -> None:
        """Raise ValueError if the usual age of the sensor readings exceeds a limit [s]."""


class DriveReading(NamedTuple):
    """The latest values of a drive, all valid at the same time."""

    time: float
    """Time of the values [s]; more than one tick ago if no newer values have arrived."""
    angle: float
    """Shaft angle [rad]."""
    velocity: float
    """Shaft angular velocity [rad/s]."""
    current: float | None
    """Motor current [A]; None if not measured."""
    following_error: float | None
    """Angle demanded by the drive minus the actual angle [rad]; None if not measured."""
    voltage: float | None = None
    """Supply voltage [V]; None if not measured."""


class ForceReading(NamedTuple):
    """The latest force."""

    force_time: float
    """Time of the filtered wrench [s]: the time of the latest record minus all delays."""
    wrench: Wrench
    """Filtered force and torque in softfin's axes [N, N m]."""
    peak: Wrench
    """Maximum magnitudes of the unfiltered records since the previous read; used for safety limits
    because the filter is slow."""


class CurrentLimits(NamedTuple):
    """Limits of a drive for the motor current [A]; None if unknown."""

    peak_a: float | None
    continuous_a: float | None


class Drive(Protocol):
    """A drive that turns the fin shaft to target angles."""

    @property
    def config(self) -> DriveConfig:
        """Configuration."""

    @property
    def where(self) -> str:
        """Location of the drive for messages, e.g. its bus and its number on the bus."""

    @property
    def device_lock(self) -> DeviceLock:
        """Lock acquired by `connect` so that no second program uses the drive."""

    @property
    def serial(self) -> int | None:
        """Serial number; None if the drive does not report it or has not been connected."""

    @property
    def identity(self) -> dict[str, int | str | None]:
        """Properties of the open drive, by name, that may affect whether it stops by itself: type,
        identifiers, and settings such as a homing offset. A proof is valid only as long as these
        properties do not change."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the drive setup since the drive was opened, one line each."""

    @property
    def referenced(self) -> bool:
        """Whether the zero angle of the fin is known."""

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on after a stop; None if the motor is confirmed to be
        off."""

    def connect(self) -> None:
        """Connect to the drive, in any state, without changing anything; raises RigError or
        DeviceError on failure."""

    def open(self) -> None:
        """Connect, run checks, and write and read back the configuration; the motor stays off. On
        failure, close the drive and raise RigError or DeviceError."""

    def read(self) -> DriveReading:
        """Return the latest values, and send what keeps the drive from stopping by itself. Called
        once per tick; must not wait longer than a few milliseconds."""

    def read_angle(self) -> float:
        """Return the current shaft angle [rad]; may take 20 ms."""

    def enable(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Power the motor, which holds its position. If this raises RigError or DeviceError, the
        motor is off. `meanwhile` is called every few milliseconds."""

    def command(self, target: Target) -> None:
        """Start moving to a target and return immediately; raises CommandError if the target is
        outside the limits, and DeviceError if the drive has not been enabled since the last
        stop."""

    def stop(self) -> None:
        """Brake as fast as the drive allows, then disable the motor; may be called repeatedly from
        any thread and never raises."""

    def close(self) -> None:
        """Stop and disconnect; may be called repeatedly and never raises."""

    def zero(self) -> None:
        """Make the current angle the zero angle of the fin; nothing moves. The drive must be
        open."""

    def reset_fault(self) -> str | None:
        """Acknowledge the drive fault and return its description; None if there was no fault. The
        motor stays off. Raises DeviceError if the fault persists."""

    def switch_off(self) -> None:
        """Stop the motor unconditionally, no matter which program powered it; raises DeviceError if
        it is not confirmed to be off."""

    def prove_stop(self) -> float:
        """Power the motor at rest and send nothing; return the time until the drive stops by itself
        [s]. Raises DeviceError if it does not stop."""

    def checks(self) -> Iterator[CheckResult]:
        """Yield lines for `softfin rig check` about the open drive; the first describes it."""

    def current_limits(self) -> CurrentLimits:
        """Return the limits of the open drive for the motor current."""

    def complaints(self) -> tuple[str, ...]:
        """Return one line per fault as of the latest read; each line ends with the fix."""

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name."""
