"""Test whether a drive stops a moving fin by itself. The program that swings the fin is killed or
suspended several times, and the drive must stop the fin each time.

The program runs as a separate process (``python -m softfin.rig.prove_moving RIG``), which writes
the fin angle at each tick. For a rig in simulated time, a session in this process falls silent
instead. After the death, softfin is also silent, because reading some drives keeps them moving.
"""

import math
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from statistics import median
from typing import NamedTuple

from softfin.core.errors import ConfigurationError, DeviceError, SafetyStop, SoftfinError
from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import RigConfig, load_rig
from softfin.rig.machine import Target
from softfin.rig.prove import removed_on_failure
from softfin.rig.record import MovingProof, StopProof, load_record, save_record
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard, Trip
from softfin.rig.session import Session
from softfin.rig.stop import StopRequest

DEATHS = 5
"""Number of times that the program is killed, and also that it is suspended."""

SWING_RAD = 0.3
"""Amplitude of the swing around the rest angle of the fin [rad]."""

LEFT_RAD = 0.1
"""Angle beyond the swing at which the fin is stopped [rad]."""

FASTEST_RAD_S = 1.0
"""Maximum velocity of the swing [rad/s]."""

WAY_RAD = 0.3
"""Maximum rotation of the fin after a death [rad]; with a longer heartbeat, the swing is slower."""

EARLY_RAD = 0.1
"""Distance from the middle beyond which the program dies at the beginning of a stroke [rad]. A fin
that does not stop then turns by more than `WAY_RAD`, to the end of the swing."""

MARGIN_S = 0.1
"""Reaction time of a drive, in addition to the heartbeat and the braking time [s]."""

STILL_S = 0.1
"""Time for which the fin must not turn [s], and tolerance of the angle [rad]."""
STOPPED_RAD = 0.01

PROGRAM_STOP_S = 3.0
"""Maximum wait for the program to stop its fin [s]."""

SIMULATED_WATCHDOG_S = 2.0
"""Timeout of softfin's own watchdog while a death is simulated [s]; the drive must react first."""


class Swing(NamedTuple):
    """A swing that suits the limits and heartbeat of a rig."""

    middle_rad: float
    velocity_rad_s: float
    silence_s: float
    """Time within which the drive must be at a standstill after its program died [s]."""

    @classmethod
    def of(cls, config: RigConfig) -> "Swing":
        """Return the swing for a rig; raises ConfigurationError if the range of the rig is too
        small."""
        drive = config.drive
        limits = drive.limits
        middle_rad = limits.rest_angle
        if not (
            limits.angle_min <= middle_rad - SWING_RAD
            and middle_rad + SWING_RAD <= limits.angle_max
        ):
            raise ConfigurationError(
                f"rig of {config.fin}: the fin must be able to swing by {SWING_RAD:g} rad to both "
                f"sides of {middle_rad:g} rad, but its range is {limits.angle_min:g} to "
                f"{limits.angle_max:g} rad; widen drive.angle_min_rad and drive.angle_max_rad"
            )
        braking_s = FASTEST_RAD_S / drive.acceleration_rad_s2
        silence_s = drive.heartbeat_s + braking_s + MARGIN_S
        velocity_rad_s = min(FASTEST_RAD_S, WAY_RAD / silence_s)
        # Stay within the limits of the drive, even if the fin then turns by less or more than
        # WAY_RAD.
        velocity_rad_s = min(max(velocity_rad_s, limits.velocity_min), limits.velocity_max)
        return cls(middle_rad, velocity_rad_s, silence_s)

    def angles(self, session: Session) -> Iterator[float]:
        """Swing the fin of an inactive session and yield its angle at each tick [rad]."""
        self._check_inside(session, session.tick().angle)
        session.activate()
        session.rest(0.0)
        stroke_s = 2 * SWING_RAD / self.velocity_rad_s
        for number in count():
            side = 1 if number % 2 == 0 else -1
            session.command(Target(self.middle_rad + side * SWING_RAD, self.velocity_rad_s))
            for _ in range(round((stroke_s + MARGIN_S) * RATE_HZ)):
                angle = session.tick().angle
                self._check_inside(session, angle)
                yield angle

    def until_death(self, angles: Iterable[float], ticks: int) -> float:
        """Return the angle at which the program dies: early in a stroke, after at least `ticks`
        ticks."""
        least_rad = self.velocity_rad_s * TICK_S / 2
        before = self.middle_rad
        for number, angle in enumerate(angles):
            turned_rad = angle - before
            before = angle
            # Positive beyond the middle of the stroke.
            place_rad = math.copysign(1.0, turned_rad) * (angle - self.middle_rad)
            if number >= ticks and abs(turned_rad) > least_rad and place_rad < -EARLY_RAD:
                return angle
        raise DeviceError("softfin ended before the fin moved; run this command again")

    def _check_inside(self, session: Session, angle: float) -> None:
        if abs(angle - self.middle_rad) > SWING_RAD + LEFT_RAD:
            problem = (
                f"fin is at {angle:.2f} rad, outside the swing around {self.middle_rad:.2f} rad; "
                "turn it back by hand"
            )
            session.abort(Trip("swing", problem))


def prove_moving(
    rig: Rig,
    deaths: int = DEATHS,
    tell: Callable[[str], object] = lambda line: None,
) -> StopProof:
    """Kill and suspend a program that swings the fin, `deaths` times each, and add the results to
    the proof that the drive stops by itself, which must exist.

    `rig` must be closed; `tell` is called with a line about each death. If the drive does not stop
    in time, removes the proof and raises DeviceError. Raises SafetyStop if the test is interrupted.
    """
    config = rig.config
    clock = rig.clock
    swing = Swing.of(config)
    ways = []
    with _switched_off_after_error(config, clock):
        for number in (signal.SIGKILL, signal.SIGSTOP) * deaths:
            way_rad = _try_death(config, clock, swing, number)
            tell(f"{number.name}: turned {way_rad:.3f} rad, at rest when checked")
            ways.append(way_rad)
    record = load_record(config.file)
    assert record.stop_proof is not None, "it was proved first"
    moving = MovingProof(
        deaths=len(ways),
        velocity_rad_s=round(swing.velocity_rad_s, 4),
        way_median_rad=round(median(ways), 4),
        way_worst_rad=round(max(ways), 4),
    )
    proof = record.stop_proof.model_copy(update={"moving": moving})
    save_record(config.file, record.model_copy(update={"stop_proof": proof}))
    return proof


@contextmanager
def _switched_off_after_error(config: RigConfig, clock: Computer) -> Iterator[None]:
    """Switch the motor off after any error; raises SafetyStop if the motor may still be on, or
    after an interruption."""
    try:
        yield
    except BaseException as error:
        reason = str(error) if isinstance(error, SoftfinError) else "interrupted"
        rig = Rig(config, clock)
        try:
            rig.drive.switch_off()
        except SoftfinError as failure:
            raise SafetyStop(f"{reason}; BUT {failure}") from error
        finally:
            rig.close()
        if isinstance(error, KeyboardInterrupt):
            raise SafetyStop("stopped, motor disabled: interrupted") from error
        raise


class _MortalRig(Rig):
    """A rig whose program can die in simulated time and then no longer reacts to faults."""

    is_dead = False

    def stop(self) -> None:
        if not self.is_dead:
            super().stop()


def _try_death(config: RigConfig, clock: Computer, swing: Swing, number: signal.Signals) -> float:
    """Return the angle by which the fin turned after the death of the program [rad]."""
    # Choose a random time in the cycles of the drive, in the first or a later stroke.
    ticks = random.randrange(2 * RATE_HZ)
    rig = _MortalRig(config, clock)
    if not clock.is_simulated:
        died_angle, silent_s = _kill_program(config, swing, number, ticks)
        with removed_on_failure(config):
            return _look(config, clock, swing, died_angle, silent_s)
    guard = Guard(config.safety.model_copy(update={"watchdog_s": SIMULATED_WATCHDOG_S}), rig.limits)
    with Session(rig, guard) as session:
        died_angle = swing.until_death(swing.angles(session), ticks)
        rig.is_dead = True
        rig.clock.sleep(swing.silence_s)
        try:
            with removed_on_failure(config):
                return _look(config, clock, swing, died_angle, swing.silence_s)
        finally:
            rig.is_dead = False


def _kill_program(
    config: RigConfig, swing: Swing, number: signal.Signals, ticks: int
) -> tuple[float, float]:
    """Run the program until it dies; return its last angle [rad] and the time since its death
    [s]."""
    with subprocess.Popen(
        [sys.executable, "-m", "softfin.rig.prove_moving", str(config.file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            try:
                last_angle = swing.until_death(map(_read_angle, process.stdout), ticks)
            except BaseException:
                # The program stops the fin when its input ends; if the program were killed, only
                # the drive would stop the fin.
                process.stdin.close()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(PROGRAM_STOP_S)
                raise
            process.send_signal(number)
            died = COMPUTER()
            COMPUTER.sleep(swing.silence_s)
            # A suspended program releases its devices only when it ends.
            process.kill()
            lines = process.stdout.read().splitlines()
            for line in lines:
                last_angle = _read_angle(line)
            return last_angle, COMPUTER() - died
        finally:
            process.kill()


def _read_angle(line: str) -> float:
    try:
        return float(line)
    except ValueError:
        raise DeviceError(f"the fin did not swing: {line.strip()}") from None


def _look(
    config: RigConfig, clock: Computer, swing: Swing, died_angle: float, silent_s: float
) -> float:
    """Read the drive after its program has died, and return the angle by which the fin has turned
    [rad]; raises DeviceError if the drive has not stopped the fin by itself."""
    rig = Rig(config, clock)
    drive = rig.drive
    began = rig.clock()
    try:
        drive.connect()
        if drive.reset_fault() is None:
            raise DeviceError(
                f"drive did not react when softfin died: no fault after {silent_s:.1f} s; see "
                "docs/rig-safety.md, and do not move the fin until this test passes"
            )
        drive.close()
        drive.open()
        angle = drive.read_angle()
        seen_s = silent_s + rig.clock() - began
        rig.clock.sleep(STILL_S)
        later_rad = abs(drive.read_angle() - angle)
    finally:
        rig.close()
    fix = "check the reaction of the drive to a lost host; for a servo, update the firmware"
    if later_rad > STOPPED_RAD:
        raise DeviceError(f"fin was still turning {seen_s:.1f} s after softfin died; {fix}")
    way_rad = abs(angle - died_angle)
    most_rad = max(WAY_RAD, swing.velocity_rad_s * swing.silence_s)
    if way_rad > most_rad:
        raise DeviceError(
            f"fin turned by {way_rad:.2f} rad after softfin died; the maximum allowed is "
            f"{most_rad:.2f}; {fix}"
        )
    return way_rad


def main() -> None:
    """Swing the fin of a rig file until this process is killed or its input ends."""
    config = load_rig(Path(sys.argv[1]))
    request = StopRequest()

    def await_end() -> None:
        sys.stdin.read()
        request.ask("emergency_stop", "the test was interrupted")

    COMPUTER.spawn(await_end, "end of input")
    try:
        rig = Rig(config)
        with Session(rig, Guard(config.safety, rig.limits), stop=request) as session:
            session.stop_on_signals()
            for angle in Swing.of(config).angles(session):
                sys.stdout.write(f"{angle:.5f}\n")
                sys.stdout.flush()
    except SoftfinError as error:
        sys.stdout.write(f"{error}\n")


if __name__ == "__main__":
    main()
