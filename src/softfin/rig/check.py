"""Is the rig well? Bus, drive, sensor, limits, clock and disk are looked at one by one; nothing moves."""

import contextlib
import os
import shutil
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from softfin.core.clock import Clock
from softfin.core.errors import SoftfinError
from softfin.core.quantities import RATE_HZ
from softfin.rig.config import RigConfig
from softfin.rig.pace import Pace
from softfin.rig.rig import Rig
from softfin.rig.simulated_clock import SimulatedClock

LATE_MS = 2.0
"""99% of all ticks should come no later than this [ms]."""

NEEDED_MB = 500
"""Of free disk: some hours of recording at about 40 kB/s."""

SLOW_S = 0.2
"""For one small write that is forced to the disk."""


class Finding(NamedTuple):
    """One line of the table."""

    what: str
    state: Literal["well", "note", "wrong"]
    text: str


Checked = Generator[Finding, None, bool]
"""Findings, and at the end whether the device answers."""


def check_rig(config: RigConfig, folder: Path, seconds: float = 3.0, clock: Clock | None = None) -> Iterator[Finding]:
    """Findings as they come; the loop runs for so long without moving."""
    drive, rig = config.drive, Rig(config, clock)
    yield Finding("rig file", "well", f"fin {config.fin!r}, {drive.encoder_lines} lines, gear {drive.gear_ratio:g}")
    yield from _disk(folder, isinstance(rig.clock, SimulatedClock))
    sensor_well = yield from _sensor(rig)
    drive_well = yield from _drive(rig)
    if sensor_well and drive_well:
        yield from _loop(rig, seconds)


def _sensor(rig: Rig) -> Checked:
    try:
        rig.sensor.open()
    except SoftfinError as error:
        yield Finding("force sensor", "wrong", str(error))
        return False
    try:
        settings = rig.sensor.settings
        product = "sensor" if settings is None else settings.product
        yield Finding("force sensor", "well", f"{product}, {rig.sensor.rate_hz:.0f} records/s, filter delays "
                      f"{rig.sensor.delay_s * 1e3:.1f} ms")  # fmt: skip
        still = rig.sensor.measured(1.0)
        force, noise = still.mean[:3], still.std[:3]
        size = max(map(abs, force))
        zero: Literal["well", "note"] = "well" if size < 0.2 else "note"
        advice = "" if zero == "well" else "; with the fin at rest in water: softfin rig zero"
        yield Finding("force at rest", zero, f"({force[0]:+.3f}, {force[1]:+.3f}, {force[2]:+.3f}) N, noise "
                      f"({noise[0]:.3f}, {noise[1]:.3f}, {noise[2]:.3f}) N a record{advice}")  # fmt: skip
        for line in rig.sensor.complaints():
            yield Finding("sensor status", "wrong", line)
        return True
    except SoftfinError as error:
        yield Finding("force sensor", "wrong", str(error))
        return False
    finally:
        rig.close()


def _drive(rig: Rig) -> Checked:
    config = rig.config
    where = f"{config.bus.interface} {config.bus.channel}, node {config.drive.node}"
    try:
        rig.drive.open()
    except SoftfinError as error:
        yield Finding("drive", "wrong", f"{where}: {error}")
        return False
    try:
        reading = rig.drive.sync_and_read(0.02)
        yield Finding("drive", "well", f"{where}: limits, ramps and mapping written and read back")
        inside = config.drive.angle_min_rad <= reading.angle <= config.drive.angle_max_rad
        yield Finding("angle", "well" if inside else "wrong", f"{reading.angle:+.3f} rad, limits "
                      f"{config.drive.angle_min_rad:+.2f} .. {config.drive.angle_max_rad:+.2f} rad")  # fmt: skip
        known = rig.drive.referenced or not config.drive.zero_needed
        yield Finding("zero", "well" if known else "wrong",
                      "known" if known else "not known since power-up: softfin rig zero")  # fmt: skip
        for line in rig.drive.complaints():
            yield Finding("drive status", "wrong", line)
        return True
    except SoftfinError as error:
        yield Finding("drive", "wrong", str(error))
        return False
    finally:
        rig.close()


def _loop(rig: Rig, seconds: float) -> Iterator[Finding]:
    pace = Pace(clock=rig.clock)
    try:
        rig.open()
        pace.start()
        complaints: tuple[str, ...] = ()
        cpu = time.process_time()
        for _ in range(round(seconds * RATE_HZ)):
            pace.wait()
            complaints = complaints or rig.read().complaints
        load = (time.process_time() - cpu) / seconds
    except SoftfinError as error:
        yield Finding("100 Hz loop", "wrong", str(error))
        return
    finally:
        rig.close()
    counted = rig.counters()
    yield _lateness(pace.described(), load, isinstance(rig.clock, SimulatedClock))
    lost = counted["sensor_lost"]
    text = complaints[0] if complaints else f"{lost} of {counted['sensor_records']} force records lost"
    yield Finding("readings", "wrong" if complaints else "note" if lost else "well", text)


def _lateness(clock: dict[str, int | float], load: float, simulated: bool) -> Finding:
    if simulated:
        return Finding("100 Hz loop", "note", "in simulated time nothing is late; softfin rig emulate --real-time "
                       "shows what this computer can do")  # fmt: skip
    late = clock["late_p99_ms"]
    steady = late <= LATE_MS and not clock["skipped_ticks"]
    return Finding("100 Hz loop", "well" if steady else "wrong", f"99% of ticks within {late:g} ms, worst "
                   f"{clock['late_max_ms']:g} ms, {load:.0%} of one core"
                   + ("" if steady else "; end other programs, or use a quieter computer"))  # fmt: skip


def _disk(folder: Path, simulated: bool = False) -> Iterator[Finding]:
    """In simulated time a slow disk holds nobody up."""
    here = folder if folder.exists() else Path.cwd()
    free = shutil.disk_usage(here).free / 1e6
    probe = here / f".softfin-check-{os.getpid()}"
    start = time.monotonic()
    try:
        # Never through a link that somebody put there.
        with probe.open("xb") as file:
            file.write(bytes(100_000))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        yield Finding("disk", "wrong", f"{here}: cannot be written ({error.strerror})")
        return
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
    took = time.monotonic() - start
    enough = free >= NEEDED_MB and (simulated or took <= SLOW_S)
    yield Finding("disk", "well" if enough else "wrong", f"{here}: {free:,.0f} MB free, a forced write takes "
                  f"{took * 1e3:.0f} ms" + ("" if enough else f"; make {NEEDED_MB} MB room"))  # fmt: skip
