"""Motions used in commissioning: swings, provoked stops, and a host that dies while the fin
moves."""

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from softfin.core.errors import DeviceError, RigError, SafetyStop
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import RigConfig
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Epos2Config, Units
from softfin.rig.devices.epos2.connection import CanConnection
from softfin.rig.devices.epos2.procedures import read_fault
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from softfin.rig.stop import StopRequest

HALF_STROKE_TICKS = 60
"""Minimum number of ticks between commands of a swing; after a shorter stroke, the fin waits."""

WATCHDOG_S = 2.0
"""Timeout of softfin's watchdog while a dead host is emulated [s]; long enough for the drive to
stop the fin first."""

WATCHED_S = 3.0
"""Longest time for which a drive is monitored after its host has died [s]."""


@dataclass
class Peaks:
    """Largest magnitudes of the readings during a motion."""

    following_rad: float = 0.0
    current_a: float = 0.0
    force_n: float = 0.0
    torque_nm: float = 0.0

    def take(self, sample: Sample) -> None:
        """Update the peaks with one sample."""
        loads = sample.peak or sample.wrench
        self.following_rad = max(self.following_rad, abs(sample.following_error or 0.0))
        self.current_a = max(self.current_a, abs(sample.current or 0.0))
        self.force_n = max(self.force_n, *map(abs, loads[:3]))
        self.torque_nm = max(self.torque_nm, *map(abs, loads[3:]))


@dataclass(frozen=True)
class Stopped:
    """Result of a motion."""

    cause: str
    """Short name of the stop's cause, e.g. ``following``; "none" if the motion ended by itself."""
    reason: str
    seconds: float
    """Time from the last good reading to the end of the stop [s]."""
    is_confirmed: bool
    """Whether the drive confirmed that its motor is off."""
    peaks: Peaks
    skipped_ticks: int
    """Number of ticks skipped by the loop."""


def changed(
    config: RigConfig, drive: JsonObject | None = None, safety: JsonObject | None = None
) -> RigConfig:
    """Return a rig's configuration with some drive or safety values replaced; raises
    ConfigurationError if it is invalid."""
    values = config.model_dump()
    values["drive"] |= drive or {}
    values["safety"] |= safety or {}
    return RigConfig.build(values, "commissioning")


def narrowed(config: RigConfig, angle_rad: float, velocity_rad_s: float) -> RigConfig:
    """Return a rig's configuration with commands limited to +-`angle_rad` and `velocity_rad_s`."""
    # The minimum velocity must stay below the new maximum.
    slowest = min(config.drive.slowest_rad_s, 0.5 * velocity_rad_s)
    drive = {
        "angle_min_rad": -angle_rad,
        "angle_max_rad": angle_rad,
        "slowest_rad_s": slowest,
        "fastest_rad_s": velocity_rad_s,
    }
    return changed(config, drive)


def swings(
    amplitude_rad: float, velocity_rad_s: float, strokes: int | None = None
) -> Iterator[Target]:
    """Yield the target of each stroke from side to side, endlessly unless `strokes` is given."""
    number = 0
    while strokes is None or number < strokes:
        side = 1 if number % 2 == 0 else -1
        yield Target(side * amplitude_rad, velocity_rad_s)
        number += 1


def stroke_ticks(amplitude_rad: float, velocity_rad_s: float) -> int:
    """Return the number of ticks for a stroke from side to side, with some extra time for the
    ramps."""
    return max(HALF_STROKE_TICKS, math.ceil(RATE_HZ * (2 * amplitude_rad / velocity_rad_s + 0.2)))


def move(
    rig: Rig,
    targets: Iterator[Target],
    ticks: int,
    request: StopRequest,
    bag: Path,
    observers: Sequence[Callable[[Sample, Target | None], None]] = (),
) -> Stopped:
    """Move the fin to each target for `ticks` ticks, until the targets end or something stops
    it."""
    peaks = Peaks()
    config = rig.config
    session = Session(
        rig,
        Guard(config.safety, rig.limits),
        stop=request,
        observers=[*observers, lambda sample, _: peaks.take(sample)],
    )
    try:
        with session, session.recording(bag):
            session.stop_on_signals()
            session.activate()
            session.rest(0.0)
            for target in targets:
                session.hold(target, ticks)
            session.rest(0.0)
            session.deactivate()
    except SafetyStop as stop:
        seconds = math.inf if session.newest is None else rig.clock() - session.newest.time
        cause = session.trip.cause if session.trip else "none"
        return Stopped(
            cause, str(stop), seconds, rig.stop_unconfirmed is None, peaks, session.pace.skipped
        )
    return Stopped(
        "none", "ended by itself", 0.0, rig.stop_unconfirmed is None, peaks, session.pace.skipped
    )


@dataclass(frozen=True)
class Death:
    """A drive's reaction to the death of its host."""

    seconds: float
    """Time from the death until the fin is at rest with its motor off [s]; infinite if that was not
    observed."""
    way_rad: float
    """Angle travelled by the fin after the death [rad]."""
    fault: str | None
    """The drive's fault afterwards."""


def epos2_config(config: RigConfig) -> Epos2Config:
    """Return the configuration of a rig's EPOS2; raises RigError for another drive, for which there
    are no acceptance steps yet."""
    if not isinstance(config.drive, Epos2Config):
        raise RigError(
            f"rig of {config.fin}: commissioning supports only drive.type epos2, got "
            f"{config.drive.type}; follow docs/commissioning.md by hand"
        )
    return config.drive


class DriveWatch:
    """Monitor that reads a drive only over SDO, while or after another program drives it; sends no
    heartbeat and no SYNC."""

    def __init__(self, config: RigConfig, clock: Computer) -> None:
        drive = epos2_config(config)
        assert config.bus is not None, "RigConfig requires a bus for this drive"
        self._units = Units.of(drive)
        self._clock = clock
        self._connection = CanConnection(
            config.bus, drive.node, lambda cob_id, data: None, lambda problem: None, clock
        )

    def __enter__(self) -> "DriveWatch":
        self._connection.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def angle(self) -> float:
        """Return the shaft angle [rad]."""
        return self._units.angle(self._connection.read(protocol.POSITION))

    def is_powered(self) -> bool:
        """Return whether the motor is powered."""
        state = protocol.decode(self._connection.read(protocol.STATUSWORD))
        return state not in protocol.UNPOWERED

    def is_referenced(self) -> bool:
        """Return whether the drive still has its zero."""
        return bool(self._connection.read(protocol.STATUSWORD) & protocol.Bit.REFERENCED)

    def fault(self) -> str | None:
        """Return a description of the drive's fault; None if it is not in fault."""
        return read_fault(self._connection)

    def watch(self, died: float, angle: float) -> Death:
        """Wait until the fin is at rest with its motor off; its host died at time `died` [s] and
        angle `angle` [rad]."""
        stood_since = died
        off_since: float | None = None
        before = math.nan
        now = died
        while now - died < WATCHED_S:
            with suppress(DeviceError):
                here = self.angle()
                now = self._clock()
                if here != before:
                    stood_since = now
                before = here
                if self.is_powered():
                    off_since = None
                elif off_since is None:
                    off_since = now
                # A fin is at rest if its position has not changed for 0.1 s.
                if off_since is not None and now - stood_since > 0.1:
                    seconds = max(stood_since, off_since) - died
                    return Death(seconds, abs(here - angle), self.fault())
            self._clock.sleep(0.002)
            now = self._clock()
        return Death(math.inf, abs(before - angle), self.fault())


def die_in_process(config: RigConfig, clock: Computer, moment: int, bag: Path) -> Death:
    """Emulate a dead host in simulated time: swing through the rig's range and stop sending at tick
    `moment`."""
    drive = config.drive
    # softfin's own watchdog would otherwise stop the fin first.
    rig = Rig(changed(config, safety={"watchdog_s": WATCHDOG_S}), clock)
    session = Session(rig, Guard(rig.config.safety, rig.limits))
    ticks = stroke_ticks(drive.angle_max_rad, drive.fastest_rad_s)
    with DriveWatch(config, clock) as watch, session, session.recording(bag):
        session.activate()
        session.rest(0.0)
        for number, target in enumerate(swings(drive.angle_max_rad, drive.fastest_rad_s)):
            session.command(target)
            for tick in range(ticks):
                sample = session.tick()
                if number * ticks + tick == moment:
                    return watch.watch(clock(), sample.angle)
    raise AssertionError("swings never end")


def die_by_signal(config: RigConfig, number: signal.Signals, wait_s: float, bag: Path) -> Death:
    """Run a process that swings the fin, and send it a signal `wait_s` after the fin starts to move
    [s]."""
    process = subprocess.Popen(
        [sys.executable, "-m", "softfin.rig.commissioning.host", str(bag)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        # Keep the pipe open: when it ends, also because this process dies, the host stops the fin.
        process.stdin.write(f"{json.dumps(config.model_dump(mode='json'))}\n")
        process.stdin.flush()
        first_line = process.stdout.readline().strip()
        if first_line != "moves":
            reason = first_line or "see the lines above"
            raise DeviceError(f"rig of {config.fin}: the fin did not start to move ({reason})")
        COMPUTER.sleep(wait_s)
        with DriveWatch(config, COMPUTER) as watch:
            angle = watch.angle()
            process.send_signal(number)
            return watch.watch(COMPUTER(), angle)
    except BaseException:
        # The host stops its fin at the end of its input; if killed first, it would leave that to
        # the drive.
        process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(WATCHED_S)
        raise
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
