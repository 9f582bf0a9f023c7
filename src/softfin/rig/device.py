"""Interface of a rig drive, and the configurations and readings of drives and force sensors.

A device is a folder in `rig/devices`, or a package of yours with an entry point in the group
`softfin.devices`. It consists of a configuration and a class that implements `Drive`, or
`softfin.rig.streamed_sensor.RecordSource` for a force sensor; `DriveType` or `ForceSensorType` of
`softfin.rig.device_type` names both. `softfin.testing.check_drive` and `check_force_sensor` test an
implementation.

All times are from the `clock` that the device is given [s]. All calls come from one thread at a
time, except that any thread may call `Drive.stop`.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import ClassVar, Literal, NamedTuple, Protocol

from pydantic import Field, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import SoftfinError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Target, Wrench

MARKS = {"well": "ok", "note": "note", "wrong": "WRONG"}
"""How the state of a result is printed."""
MAX_BRAKE_S = 0.5
"""Longest allowed braking from the highest velocity [s]; softfin does not wait any longer."""


class CheckResult(NamedTuple):
    """One line of the table of `softfin rig check`."""

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
    """Return whether a field of a device's configuration only defines its address, which may change
    at any time; the others affect the readings or the motion."""
    return field in ("address", "port", "connection") or field.endswith("_port")


def drop_address(device: JsonObject) -> JsonObject:
    """Return a device's configuration without the fields of its address."""
    return {name: value for name, value in device.items() if not is_address(name)}


class DriveConfig(DeviceConfig):
    """Settings that softfin needs from every drive."""

    DEFAULT_TYPE = "epos2"
    NEEDS_BUS: ClassVar[bool] = False
    """Whether the rig file needs a CAN bus for this drive."""
    ZERO_POWERS_MOTOR: ClassVar[bool] = True
    """Whether `Drive.zero` powers the motor and therefore needs a proof of the drive's own stop."""

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
    """Deceleration of a stop [rad/s2]; no default, because it depends on what the fin mount can
    withstand."""
    direction: Literal[1, -1] = 1
    """-1 if the positive direction of the drive corresponds to negative fin angles."""
    heartbeat_s: float = Field(0.2, ge=0.1, le=1)
    """Time without a message from softfin after which the drive stops by itself [s]."""
    zero_needed: bool = True
    """Refuse to move until the fin has been zeroed after each power-up of the drive; set to false
    only for an absolute encoder."""

    @property
    def limits(self) -> Limits:
        """Command limits."""
        return Limits(
            self.angle_min_rad, self.angle_max_rad, self.slowest_rad_s, self.fastest_rad_s
        )

    @property
    def summary(self) -> str:
        """The settings to compare with the device, in a few words."""
        return self.type

    @property
    def host(self) -> int | None:
        """Number of this program on the drive bus; None if the bus has none."""
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
    from the right-hand rule. No default, because it depends on how the sensor is mounted."""

    def check_stale(self, force_stale_s: float) -> None:
        """Raise ValueError if the sensor readings are usually older than a limit on their age
        [s]."""


class DriveReading(NamedTuple):
    """The latest values of a drive, all valid at the same time."""

    time: float
    """Time of the values [s]; more than one tick old if no newer ones have arrived."""
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
    """Time of the filtered wrench [s]: time of the latest record minus all delays."""
    wrench: Wrench
    """Filtered force and torque in softfin's axes [N, N m]."""
    peak: Wrench
    """Largest magnitudes of the unfiltered records since the previous read; used for safety limits,
    because the filter is slow."""


class CurrentLimits(NamedTuple):
    """Limits of a drive for the motor current [A]; None if unknown."""

    peak_a: float | None
    continuous_a: float | None


class Drive(Protocol):
    """A drive that turns the fin's shaft to target angles."""

    @property
    def config(self) -> DriveConfig:
        """Configuration."""

    @property
    def where(self) -> str:
        """How the drive is reached, for messages, e.g. its bus and its number there."""

    @property
    def device_lock(self) -> DeviceLock:
        """Lock acquired by `connect`, so that no second program uses the drive."""

    @property
    def serial(self) -> int | None:
        """Serial number; None if the drive does not report it or has not been connected."""

    @property
    def identity(self) -> dict[str, int | str | None]:
        """Properties of the open drive that may affect its own stop, by name: type, identifiers,
        and settings such as a homing offset. A proof of the stop is valid only while they do not
        change."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the drive setup since it was opened, one line each."""

    @property
    def referenced(self) -> bool:
        """Whether the fin's zero is known."""

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on after a stop; None if it is confirmed to be
        off."""

    def connect(self) -> None:
        """Connect to the drive in any state without changing anything; raises RigError or
        DeviceError."""

    def open(self) -> None:
        """Connect, check, and write and read back the configuration; the motor stays off. On
        failure, close again and raise RigError or DeviceError."""

    def read(self) -> DriveReading:
        """Return the latest values; called once per tick, must not wait longer than a few
        milliseconds. Also sends what keeps the drive from stopping by itself."""

    def read_angle(self) -> float:
        """Return the shaft angle now [rad]; may wait 20 ms."""

    def enable(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Power the motor, which holds its position; if this raises RigError or DeviceError, the
        motor is off. `meanwhile` is called every few milliseconds."""

    def command(self, target: Target) -> None:
        """Start moving to a target and return immediately; raises CommandError if it is outside the
        limits, and DeviceError if the drive has not been enabled since the last stop."""

    def stop(self) -> None:
        """Brake as fast as the drive allows, then disable the motor; may be called repeatedly from
        any thread and never raises."""

    def close(self) -> None:
        """Stop and disconnect; may be called repeatedly and never raises."""

    def zero(self) -> None:
        """Make the present angle the fin's zero; nothing moves. The drive must be open."""

    def reset_fault(self) -> str | None:
        """Acknowledge the drive fault and return its description; None if there was none. The
        motor stays off. Raises DeviceError if the fault persists."""

    def switch_off(self) -> None:
        """Stop the motor unconditionally, no matter which program powered it; raises DeviceError if
        it is not confirmed to be off."""

    def prove_stop(self) -> float:
        """Power the motor at rest and send nothing; return the time until the drive stops by itself
        [s]. Raises DeviceError if it does not."""

    def checks(self) -> Iterator[CheckResult]:
        """Yield lines for `softfin rig check` about the open drive; the first describes it."""

    def current_limits(self) -> CurrentLimits:
        """Return the open drive's own limits for the motor current."""

    def complaints(self) -> tuple[str, ...]:
        """Return one line per fault as of the latest read, ending with its fix."""

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name."""
