"""Checks the parts of a rig: disk, drive, sensor, limits and the 100 Hz loop. Nothing moves."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from softfin.core.errors import DeviceError, RigError, SoftfinError
from softfin.core.quantities import RATE_HZ
from softfin.rig.device import CheckResult
from softfin.rig.force_zero import ZERO_N, check_force_zero, tolerance_scale
from softfin.rig.pace import Pace
from softfin.rig.priority import NORMAL, set_loop_priority, set_priority
from softfin.rig.prove import check_proof, proving_command
from softfin.rig.rig import Rig

NEEDED_MB = 500
"""Free disk space for a few hours of recording at about 40 kB/s [MB]."""


def check_rig(rig: Rig, folder: Path, seconds: float = 3.0) -> Iterator[CheckResult]:
    """Yield each result as soon as it is available; the loop is tested for `seconds`."""
    yield CheckResult("rig file", "well", f"fin {rig.config.fin!r}, {rig.config.drive.summary}")
    yield check_disk(folder)
    all_well = True
    for what, results in (
        # The drive comes first, as in `Rig.open`, in case a second program is using both devices.
        ("drive", _check_drive(rig)),
        ("force sensor", _check_sensor(rig)),
        ("100 Hz loop", _check_loop(rig, seconds)),
    ):
        if not all_well and what == "100 Hz loop":
            return
        try:
            yield from results
        except SoftfinError as error:
            all_well = False
            yield CheckResult(what, "wrong", str(error))
        finally:
            rig.close()


def _check_sensor(rig: Rig) -> Iterator[CheckResult]:
    sensor = rig.sensor
    sensor.open()
    yield from sensor.checks()
    # This comes first, because softfin needs it to measure a sensor whose zero it keeps.
    zero_result = _check_force_zero(rig)
    mean, deviation = sensor.measured(1.0)
    force = ", ".join(f"{value:+.3f}" for value in mean[:3])
    noise = ", ".join(f"{value:.3f}" for value in deviation[:3])
    is_zero = max(map(abs, mean[:3])) < 2 * ZERO_N * tolerance_scale(rig.config)
    advice = "" if is_zero else "; with the fin at rest in the water, run: softfin rig zero --force"
    text = f"({force}) N, noise ({noise}) N per record{advice}"
    yield CheckResult("force at rest", "well" if is_zero else "note", text)
    yield zero_result
    yield from (CheckResult("sensor status", "wrong", line) for line in sensor.complaints())


def _check_force_zero(rig: Rig) -> CheckResult:
    try:
        zero = check_force_zero(rig.sensor, rig.config)
    except RigError as error:
        return CheckResult("force zero", "wrong", str(error))
    if zero is None:
        text = (
            "never set by softfin; with the fin at rest in the water, run: softfin rig zero --force"
        )
        return CheckResult("force zero", "note", text)
    return CheckResult("force zero", "well", f"set on {zero.date}, still valid")


def _check_drive(rig: Rig) -> Iterator[CheckResult]:
    config = rig.config.drive
    try:
        rig.drive.open()
    except SoftfinError as error:
        raise DeviceError(f"{rig.drive.where}: {error}") from None
    angle = rig.drive.read_angle()
    yield from rig.drive.checks()
    yield from check_currents(rig)
    yield from _check_own_stop(rig)
    inside = config.angle_min_rad <= angle <= config.angle_max_rad
    yield CheckResult(
        "angle",
        "well" if inside else "wrong",
        f"{angle:+.3f} rad, limits {config.angle_min_rad:+.2f} .. {config.angle_max_rad:+.2f} rad",
    )
    is_known = rig.drive.referenced or not config.zero_needed
    text = (
        "known"
        if is_known
        else "not known since power-up; turn the fin to zero and run: softfin rig zero --arm"
    )
    yield CheckResult("zero", "well" if is_known else "wrong", text)
    yield from (CheckResult("drive status", "wrong", line) for line in rig.drive.complaints())


def check_currents(rig: Rig) -> Iterator[CheckResult]:
    """Compare the current limits in the safety settings with the limits of the drive; a safety
    limit above the drive limit can never trip."""
    safety = rig.config.safety
    own = rig.drive.current_limits()
    for name, limit_a, own_a in (
        ("current_peak_a", safety.current_peak_a, own.peak_a),
        ("current_sustained_a", safety.current_sustained_a, own.continuous_a),
    ):
        if own_a is None or limit_a is None:
            continue
        # The drive clips the peak current at its own limit, so the current never exceeds an equal
        # safety limit.
        is_peak = name == "current_peak_a"
        if limit_a > own_a or (is_peak and limit_a == own_a):
            text = (
                f"{name} {limit_a:g} A can never trip: the drive limits the current to {own_a:g} "
                "A; lower this limit"
            )
            yield CheckResult("safety", "note", text)


def _check_own_stop(rig: Rig) -> Iterator[CheckResult]:
    """Report whether it has been proved that the drive stops if softfin dies."""
    if rig.config.file is None:
        return
    try:
        proof = check_proof(rig.config, rig.drive)
    except RigError as error:
        yield CheckResult("own stop", "note", str(error))
        return
    if proof is None:
        return
    after_ms = proof.faulted_after_s * 1000
    after = f"drive stopped {after_ms:.0f} ms after the last heartbeat from softfin"
    yield CheckResult("own stop", "well", f"{after}, proved {proof.date}")
    moving = proof.moving
    if moving is None:
        command = proving_command(rig.config.file, "--prove --moving")
        yield CheckResult("stop in motion", "note", f"not tried yet; run: {command}")
        return
    yield CheckResult("stop in motion", "well", moving.text)


def _check_loop(rig: Rig, seconds: float) -> Iterator[CheckResult]:
    rig.open()
    is_urgent = set_loop_priority(rig.clock)
    pace = Pace(rig.clock)
    complaints: tuple[str, ...] = ()
    try:
        for _ in range(round(seconds * RATE_HZ)):
            pace.wait()
            complaints = complaints or rig.read().complaints
    finally:
        set_priority(NORMAL, rig.clock)
    counted = rig.counters()
    late = pace.to_dict()
    if rig.clock.is_simulated:
        yield CheckResult(
            "100 Hz loop",
            "note",
            "nothing is late in simulated time; to test this computer, run: softfin rig emulate "
            "--real-time",
        )
    else:
        in_time = late["late_p99_ms"] <= 2.0 and not late["skipped_ticks"]
        advice = "" if in_time else "; close other programs, or use a less busy computer"
        if not is_urgent:
            advice += "; real-time priority is not allowed, see docs/rig.md"
        yield CheckResult(
            "100 Hz loop",
            "well" if in_time else "wrong",
            f"99% of ticks within {late['late_p99_ms']:g} "
            f"ms, worst {late['late_max_ms']:g} ms{advice}",
        )
    lost = counted["sensor_lost"]
    text = (
        complaints[0] if complaints else f"{lost} of {counted['sensor_records']} force records lost"
    )
    yield CheckResult("readings", "wrong" if complaints else "note" if lost else "well", text)


def check_disk(folder: Path) -> CheckResult:
    """Check that a folder is writable and has enough free space for a recording."""
    here = folder if folder.exists() else Path.cwd()
    free = shutil.disk_usage(here).free / 1e6
    try:
        tempfile.TemporaryFile(dir=here).close()
    except OSError as error:
        return CheckResult("disk", "wrong", f"{here}: cannot be written ({error.strerror})")
    advice = "" if free >= NEEDED_MB else f"; a recording needs {NEEDED_MB} MB"
    return CheckResult(
        "disk", "wrong" if advice else "well", f"{here}: {free:,.0f} MB free{advice}"
    )
