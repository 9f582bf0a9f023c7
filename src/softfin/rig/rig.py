"""The rig as a Machine: one EPOS2 and one Axia80, read together at each tick."""

import contextlib
from collections.abc import Callable

from softfin.core.clock import REAL, Clock
from softfin.core.errors import SoftfinError
from softfin.core.quantities import Limits
from softfin.rig.axia80.sensor import Axia80
from softfin.rig.config import RigConfig
from softfin.rig.epos2.drive import Epos2
from softfin.rig.machine import Sample, Target

ANSWER_S = 0.006
"""Longest wait for the drive's answers at a tick; on a real bus they take 1 ms, on a busy computer more."""

BEAT_TICKS = 4
"""Between two of our heartbeats: 40 ms, a fifth of what the drive waits for by default."""


class Rig:
    """Meets the Machine contract."""

    def __init__(self, config: RigConfig, clock: Clock | None = None) -> None:
        """On the clock of its emulation where it has one, else on the real one."""
        self._kept: Callable[[], None] | None = None
        if clock is None and config.emulation is not None:
            # Imported here: a real rig needs no tank.
            from softfin.rig.emulation.plugged import plugged

            emulated = plugged(config)
            clock, self._kept = emulated.clock, emulated.keep
        clock = clock or REAL
        self.config, self.clock = config, clock
        drive = config.drive
        self.name = f"rig of {config.fin}"
        self.limits = Limits(drive.angle_min_rad, drive.angle_max_rad, drive.slowest_rad_s, drive.fastest_rad_s)
        # A fault of the drive does not wait for the next tick.
        self.drive = Epos2(config.bus, drive, clock, on_fault=lambda _: self.stop())
        self.sensor = Axia80(config.sensor, clock)
        self._ticks = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """Of the sensor."""
        return self.sensor.notes()

    @property
    def doubt(self) -> str | None:
        """Of the drive."""
        return self.drive.stop_unconfirmed

    def open(self) -> None:
        """Connect to both and configure the drive, without power to the motor."""
        self.sensor.open()
        try:
            self.drive.open()
        except BaseException:
            self.sensor.close()
            raise

    def read(self) -> Sample:
        """Have the drive sample now; of the force, what came until now."""
        if self._ticks % BEAT_TICKS == 0:
            self.drive.send_heartbeat()
        self._ticks += 1
        drive = self.drive.sync_and_read(ANSWER_S)
        force = self.sensor.read()
        return Sample(
            time=drive.time,
            angle=drive.angle,
            velocity=drive.velocity,
            current=drive.current,
            following_error=drive.following_error,
            force_time=force.force_time,
            wrench=force.wrench,
            peak=force.peak,
            complaints=(*self.drive.complaints(), *self.sensor.complaints()),
        )

    def enable(self) -> None:
        """Power to the motor, which holds where it is."""
        self.drive.enable()

    def command(self, target: Target) -> None:
        """A new set-point, which takes effect at once."""
        self.drive.command(target)

    def stop(self) -> None:
        """Quick stop, then no voltage."""
        self.drive.stop()

    def close(self) -> None:
        """Stop, let go of both; in simulated time raises RunError where what must be remembered cannot be written."""
        self.drive.close()
        with contextlib.suppress(OSError, SoftfinError):
            self.sensor.close()
        if self._kept is not None:
            self._kept()

    def counters(self) -> dict[str, int]:
        """Of both."""
        return {**{f"drive_{name.replace(' ', '_')}": n for name, n in self.drive.counters().items()},
                **self.sensor.counters()}  # fmt: skip
