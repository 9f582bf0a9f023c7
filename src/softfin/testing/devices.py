"""Conformance tests for rig devices: a real or emulated drive or force sensor."""

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError
from softfin.rig.device import Drive, DriveReading, ForceReading
from softfin.rig.machine import Target
from softfin.rig.pace import Pace
from softfin.rig.streamed_sensor import StreamedSensor

MAX_AGE_S = 1.0
"""Maximum age of a reading [s]: the upper bound of the safety limits."""

SLOW_READ_S = 0.02
"""Maximum median duration of `read` [s]."""

SILENCE_S = 6.0
"""Maximum time until a silent device must be detected [s]."""

STEP_RAD = 0.2
AT_REST_RAD = 0.02


def check_force_sensor(sensor: StreamedSensor, silence: Callable[[], object] | None = None) -> None:
    """Check that a force sensor meets its contract: it can be closed at any time and opened again,
    and readings are finite, in order, recent and fast.

    Args:
        sensor: The sensor, with its `RecordSource`.
        silence: Function that silences the sensor. The force must then become older, and the
            sensor must report a complaint.

    Raises:
        RigError: If the contract is not met; the message names the problem and the requirement.

    Example:
        >>> check_force_sensor(sensor, silence=board.unplug)
    """
    pace = Pace(sensor.clock)
    _check_closed(sensor)
    try:
        for _ in range(2):
            sensor.open()
            _watch(sensor, pace, 200, ForceReading)
            _check_closed(sensor)
        if silence is not None:
            sensor.open()
            silence()
            _check_silence(sensor)
    finally:
        sensor.close()


def check_drive(drive: Drive, clock: Clock = REAL) -> None:
    """Check that a drive meets its contract; THE FIN MOVES by 0.2 rad and its zero is set.

    The drive must move only between `enable` and `stop`, any thread may stop it, it can be closed
    at any time and opened again, and it stops by itself.

    Args:
        drive: The drive.
        clock: Clock of the drive.

    Raises:
        RigError: If the contract is not met; the message names the problem and the requirement.

    Example:
        >>> check_drive(drive)
    """
    pace = Pace(clock)
    drive.stop()
    _check_closed(drive)
    try:
        for from_another_thread in (False, True):
            drive.open()
            if not list(drive.checks()):
                _fail(drive, "checks yields nothing", "the first line must describe the drive")
            drive.current_limits()
            _check_refusal(drive, "before it was enabled")
            drive.zero()
            if abs(drive.read_angle()) > AT_REST_RAD and drive.config.zero_needed:
                _fail(drive, f"is at {drive.read_angle():.3f} rad after zero", "it must be at zero")
            _check_still(drive, pace, "before it was enabled")
            drive.enable()
            _check_still(drive, pace, "when enabled without a command")
            _check_motion(drive, pace)
            if from_another_thread:
                clock.spawn(drive.stop, "stop").join(5.0)
            else:
                drive.stop()
            _watch(drive, pace, 50, DriveReading)
            _check_still(drive, pace, "after stop")
            _check_refusal(drive, "after stop")
            if drive.stop_unconfirmed is not None:
                _fail(drive, f"reports after stop: {drive.stop_unconfirmed}", "it must be off")
            _check_closed(drive)
        drive.open()
        stopped_after_s = drive.prove_stop()
        if not 0 < stopped_after_s <= drive.config.heartbeat_s + 1.0:
            _fail(drive, f"stopped by itself after {stopped_after_s:.2f} s", "see heartbeat_s")
    finally:
        drive.close()


def _check_closed(device: Drive | StreamedSensor) -> None:
    """Close twice; a closed device must still provide what the monitor and messages read."""
    device.close()
    device.close()
    device.complaints()
    device.counters()


def _watch(device: Drive | StreamedSensor, pace: Pace, ticks: int, kind: Any) -> list[Any]:
    """Read; each reading must be of a kind and make sense. Return the readings, which start with
    their time."""
    time_name = kind._fields[0]
    clock = pace.clock
    readings: list[Any] = []
    durations = []
    pace.start()
    for _ in range(ticks):
        pace.wait()
        started = clock()
        reading: Any = device.read()
        durations.append(clock() - started)
        if not isinstance(reading, kind):
            _fail(device, f"read returns {type(reading).__name__}", f"it must be a {kind.__name__}")
        if not np.isfinite(np.hstack([part for part in reading if part is not None])).all():
            _fail(device, f"a reading is not finite ({reading})", "drop it or report a complaint")
        if readings and reading[0] < readings[-1][0]:
            _fail(device, f"{time_name} went back", "times must increase")
        age_s = clock() - reading[0]
        if not -1e-6 <= age_s <= MAX_AGE_S:
            _fail(device, f"{time_name} is {age_s:.3f} s ago", f"it must be 0 to {MAX_AGE_S:g} s")
        if lines := device.complaints():
            _fail(device, f"complains: {lines[0]}", "there must be no fault")
        readings.append(reading)
    if (median_s := sorted(durations)[ticks // 2]) > SLOW_READ_S:
        _fail(device, f"read takes {1e3 * median_s:.0f} ms", "it must not wait")
    if readings[-1][0] == readings[0][0]:
        _fail(device, f"{time_name} does not change", "it must be the time of the values")
    return readings


def _check_silence(sensor: StreamedSensor) -> None:
    clock = sensor.clock
    end = clock() + SILENCE_S
    while not sensor.complaints():
        if clock() > end:
            _fail(sensor, f"no complaint after {SILENCE_S:g} s of silence", "report the silence")
        sensor.read()
        clock.sleep(0.01)
    if clock() - sensor.read().force_time < 0.05:
        _fail(sensor, "force_time is recent although nothing arrives", "it must stay the same")


def _check_still(drive: Drive, pace: Pace, when: str) -> None:
    angles = [reading.angle for reading in _watch(drive, pace, 50, DriveReading)]
    way = max(angles) - min(angles)
    if way > AT_REST_RAD:
        _fail(drive, f"moved by {way:.3f} rad {when}", "it must move only under a command")


def _check_motion(drive: Drive, pace: Pace) -> None:
    limits = drive.config.limits
    start = drive.read().angle
    is_low = start < (limits.angle_min + limits.angle_max) / 2
    step = STEP_RAD if is_low else -STEP_RAD
    drive.command(Target(start + step, limits.velocity_min))
    moved = _watch(drive, pace, 100, DriveReading)[-1].angle - start
    if moved / step < 0.25:
        _fail(drive, f"moved {moved:.3f} rad within 1 s", f"the command was {step} rad")
    # Leave the drive in motion so that the stop can be tested.
    drive.command(Target(start, limits.velocity_min))
    _watch(drive, pace, 3, DriveReading)


def _check_refusal(drive: Drive, when: str) -> None:
    try:
        limits = drive.config.limits
        drive.command(Target(limits.rest_angle, limits.velocity_min))
    except DeviceError:
        return
    _fail(drive, f"accepted a command {when}", "it must raise DeviceError")


def _fail(device: object, problem: str, requirement: str) -> NoReturn:
    name = getattr(device, "name", None) or getattr(device, "where", type(device).__name__)
    raise RigError(f"{name}: {problem}; {requirement}")
