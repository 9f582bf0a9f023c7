"""Safety code shared by all drives: checks before the motor is powered, and the last steps of a
stop."""

from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Generic, NamedTuple, TypeVar

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError, RigError, SafetyStop, SoftfinError
from softfin.rig.device import Drive, DriveConfig
from softfin.rig.safety import OVERSHOOT_RAD

Entry = TypeVar("Entry")

UNCONFIRMED = "drive did not confirm that its motor is off; press the emergency stop"

MIN_ATTEMPTS = 3
"""Minimum number of attempts at each step of a stop; a single unanswered request may use up the
time of the step."""

STOP_CONFIRMED_S = 0.3
"""Time for which the motor must stay off [s]; a program that still controls the drive would power
it again within this time."""


class Setting(NamedTuple, Generic[Entry]):
    """An entry of a drive, the values on which units and limits rely, and the fix for other
    values."""

    entry: Entry
    allowed: Container[int]
    fix: str


def check_settings(
    settings: Iterable[Setting[Entry]], read: Callable[[Entry], int | None], program: str
) -> tuple[str, ...]:
    """Raise RigError if a setting has an unsupported value; return one note per entry that the
    drive does not have. `program` is the program for changing the settings."""
    notes = []
    for setting in settings:
        value = read(setting.entry)
        if value is None:
            notes.append(f"drive has no {setting.entry}; check this setting in {program}")
        elif value not in setting.allowed:
            raise RigError(f"drive setting {setting.entry} is {value}: {setting.fix} in {program}")
    return tuple(notes)


def try_until(clock: Clock, done: Callable[[], bool], seconds: float, step_s: float) -> bool:
    """Retry every `step_s` [s] until `done()` returns True or for `seconds`, but at least three
    times; a DeviceError is treated as not done."""
    end = clock() + seconds
    attempts = 0
    while attempts < MIN_ATTEMPTS or clock() <= end:
        attempts += 1
        with suppress(DeviceError):
            if done():
                return True
        clock.sleep(step_s)
    return False


def stays_off(clock: Clock, is_off: Callable[[], bool], step_s: float) -> bool:
    """Return whether a motor stays off, checked every `step_s` [s]; a program that still controls
    the drive would power it again.

    Such a program may read some of the answers, but a final answer must confirm that the motor is
    off.
    """
    # Use the clock, because each answer of a silent drive takes far longer than a step.
    end = clock() + STOP_CONFIRMED_S
    while clock() < end:
        with suppress(DeviceError):
            if not is_off():
                return False
        clock.sleep(step_s)
    return try_until(clock, is_off, STOP_CONFIRMED_S, step_s)


class PausedError(DeviceError):
    """Raised if a stop test is not valid because the computer paused."""


def check_no_pause(silent_s: float, longest_s: float) -> None:
    """Raise PausedError if the stop test took longer than the limit for the drive [s], which only a
    pause of the computer can cause."""
    if silent_s > longest_s:
        raise PausedError(
            f"computer: paused for {silent_s:.1f} s during the stop test, so it is not valid; "
            "close other programs, then run the test again"
        )


def check_fin_angle(angle: float, config: DriveConfig) -> None:
    """Raise RigError if the fin angle [rad] is so far outside its range that the motor must not be
    powered."""
    low = config.angle_min_rad
    high = config.angle_max_rad
    if not low - OVERSHOOT_RAD <= angle <= high + OVERSHOOT_RAD:
        raise RigError(
            f"fin is at {angle:.3f} rad, outside {low:g} .. {high:g}; turn it back by hand, or "
            "turn it to zero and run: softfin rig zero --arm"
        )


@contextmanager
def stopped_afterwards(drive: Drive) -> Iterator[None]:
    """Stop the motor when the block ends, even after an exception; raises SafetyStop if the motor
    may still be on."""
    reason = "the drive was stopped"
    try:
        yield
    except BaseException as error:
        reason = str(error) if isinstance(error, SoftfinError) else "interrupted"
        raise
    finally:
        try:
            drive.stop()
        finally:
            # Stop once more, in case Ctrl-C interrupted the first stop; this takes no time if the
            # motor is off.
            drive.stop()
            if drive.stop_unconfirmed:
                # This error is more important than any other, because the operator is next to a
                # powered motor.
                raise SafetyStop(f"{reason}; BUT {drive.stop_unconfirmed}")
