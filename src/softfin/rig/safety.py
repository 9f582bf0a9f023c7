"""Safety limits, which the session checks at every tick. A violation stops the fin; nothing is
clipped.

The guard checks samples and targets and returns a reason to stop; its only state is recent samples.
In addition, the drive has its own limits (position, following error, current, heartbeat), and a
watchdog monitors the loop.
"""

import math
from collections import deque
from typing import NamedTuple

from pydantic import Field, PositiveFloat, model_validator

from softfin.control.controller import TrainingRange
from softfin.core.configuration import Configuration
from softfin.core.errors import CommandError
from softfin.core.quantities import Limits
from softfin.rig.machine import Sample, Target

OVERSHOOT_RAD = 0.15
"""Angle beyond the command range that a fin may reach if it is stopped during a fast stroke
[rad]."""

FORCE_PEAK_N = 30.0
"""Default of `SafetyConfig.force_peak_n` [N]."""


SUSTAINED_S = 0.5
"""Averaging time for sustained values [s]."""


class SafetyConfig(Configuration):
    """Safety limits; the defaults leave a margin for a fin like the paper's (less than 13 N and 7.3
    rad/s)."""

    angle_margin_rad: float = Field(default=OVERSHOOT_RAD, ge=0)
    """Maximum overshoot of the shaft beyond the command range [rad]."""
    velocity_rad_s: PositiveFloat = 10.0
    """Maximum angular velocity of the shaft [rad/s]."""
    acceleration_rad_s2: PositiveFloat = 200.0
    """Maximum angular acceleration of the shaft, averaged over 30 ms [rad/s2]; the profile
    acceleration of the drive must not exceed it."""
    force_peak_n: PositiveFloat = FORCE_PEAK_N
    """Maximum force on any axis at any time [N]. Above the default, the tolerances of the force at
    rest grow in proportion."""
    force_sustained_n: PositiveFloat = 15.0
    """Maximum mean magnitude of the force over 0.5 s [N]."""
    torque_peak_nm: PositiveFloat = 5.0
    """Maximum torque on any axis at any time [N m]."""
    torque_sustained_nm: PositiveFloat = 3.0
    """Maximum mean magnitude of the torque over 0.5 s [N m]."""
    current_peak_a: PositiveFloat | None = None
    """Maximum motor current at any time [A]; required for a rig; None if the current is not
    measured."""
    current_sustained_a: PositiveFloat | None = None
    """Maximum mean motor current over 0.5 s [A]."""
    stale_s: float = Field(default=0.05, ge=0.02, le=1)
    """Maximum age of the angle reading [s]."""
    force_stale_s: float = Field(default=0.15, ge=0.02, le=1)
    """Maximum age of the force reading, including the filter delay [s]."""
    following_rad: PositiveFloat = 0.2
    """Maximum following error that may last longer than `following_s` [rad]; 0.01 is typical in the
    virtual tank. If a fin is blocked during a stroke of less than twice this value, only the
    current reveals the fault."""
    following_s: float = Field(default=0.1, ge=0.02, le=2)
    """Maximum time for which the following error may exceed `following_rad` [s]."""
    overrun_s: float = Field(default=0.05, ge=0.01, le=1)
    """Maximum lateness of a tick [s]."""
    watchdog_s: float = Field(default=0.15, ge=0.05, le=2)
    """Time without a tick after which the watchdog thread stops the machine [s]."""
    training_margin: float | None = Field(default=0.5, ge=0)
    """Maximum distance of angle, velocity or force from the training range of the surrogate,
    averaged over 1 s, as a multiple of the width of the range. The controller is untested beyond
    this distance. None disables the check."""

    @model_validator(mode="after")
    def _ordered(self) -> "SafetyConfig":
        for name, unit in (("force", "n"), ("torque", "nm"), ("current", "a")):
            peak = getattr(self, f"{name}_peak_{unit}")
            sustained = getattr(self, f"{name}_sustained_{unit}")
            if (peak is None) != (sustained is None) or (peak is not None and sustained > peak):
                raise ValueError(
                    f"{name}_sustained_{unit} = {sustained} with {name}_peak_{unit} = {peak}: set "
                    "both, with the sustained value not above the peak"
                )
        return self


class Trip(NamedTuple):
    """Reason for a stop."""

    cause: str
    """Short name for recordings, e.g. ``force_peak``."""
    reason: str
    """One-line message for the user, ending with the fix."""


ACCELERATION_TICKS = 3


def check_target(target: Target, limits: Limits) -> Trip | None:
    """Return a trip if a command is outside the limits, None otherwise."""
    for name, unit, value, low, high in (
        ("angle", "rad", target.angle, limits.angle_min, limits.angle_max),
        ("velocity", "rad/s", target.velocity, limits.velocity_min, limits.velocity_max),
    ):
        if not math.isfinite(value):
            return Trip(
                "not_a_number",
                f"commanded {name} {value} {unit}: this fin accepts only finite numbers; the "
                "weights or inputs of the controller may be damaged, so evaluate the controller on "
                "a surrogate first",
            )
        # The tolerance allows for rounding errors of the controller.
        if not low - 1e-3 <= value <= high + 1e-3:
            return Trip(
                f"command_{name}",
                f"commanded {name} {value:.3f} {unit}: this fin accepts {low:.3f} to "
                f"{high:.3f} {unit}; train a controller within this range",
            )
    return None


class Guard:
    """Checks each tick against the limits and returns the first violation."""

    def __init__(
        self, config: SafetyConfig, limits: Limits, trained: TrainingRange | None = None
    ) -> None:
        self.config = config
        self.limits = limits
        self.trained = trained
        self.restart()

    def restart(self) -> None:
        """Forget all samples, so that conditions before the motor was off do not count
        afterwards."""
        self._means = {name: _Mean(SUSTAINED_S) for name in ("force", "torque", "current")}
        self._outside = _Mean(1.0)
        self._velocities: deque[tuple[float, float]] = deque(maxlen=ACCELERATION_TICKS + 1)
        self._followed: float | None = None

    def check(self, sample: Sample, now: float, late: float = 0.0) -> Trip | None:
        """Check a sample that was read at `now` [s] in a tick that was late by `late` [s]."""
        config = self.config
        if sample.complaints:
            return Trip("device", sample.complaints[0])
        optional = (sample.current, sample.following_error, sample.voltage)
        numbers = (
            sample.time,
            sample.angle,
            sample.velocity,
            sample.force_time,
            *sample.wrench,
            *(sample.peak or ()),
            *(number for number in optional if number is not None),
        )
        if not all(map(math.isfinite, numbers)):
            return Trip(
                "reading", f"a reading is not finite ({sample}); check the cables and the sensor"
            )
        if late > config.overrun_s:
            return Trip(
                "overrun",
                f"the loop was {late * 1e3:.0f} ms late, but at most "
                f"{config.overrun_s * 1e3:.0f} ms is allowed (safety.overrun_s); close other "
                "programs on this computer",
            )
        for what, age, most, way_out in (
            ("angle", now - sample.time, config.stale_s, "check the drive cable and supply"),
            (
                "force",
                now - sample.force_time,
                config.force_stale_s,
                "check the sensor cable and network",
            ),
        ):
            # A time in the future is just as bad, because it would never become stale.
            if abs(age) > most:
                return Trip(
                    f"{what}_stale",
                    f"no new {what} for {age * 1e3:.0f} ms, but at most {most * 1e3:.0f} ms is "
                    f"allowed; {way_out}",
                )
        return (
            self._check_motion(sample)
            or self._check_loads(sample, now)
            or self._check_range(sample, now)
        )

    def _check_motion(self, sample: Sample) -> Trip | None:
        config = self.config
        limits = self.limits
        low = limits.angle_min - config.angle_margin_rad
        high = limits.angle_max + config.angle_margin_rad
        if not low <= sample.angle <= high:
            return Trip(
                "angle",
                f"the shaft is at {sample.angle:.3f} rad, outside {low:.3f} to {high:.3f} rad; "
                "turn the shaft back, or if its zero is wrong, turn it to zero and run: softfin "
                "rig zero --arm",
            )
        if abs(sample.velocity) > config.velocity_rad_s:
            return Trip(
                "velocity",
                f"the shaft turns at {sample.velocity:.2f} rad/s, but at most "
                f"{config.velocity_rad_s:g} rad/s is allowed (safety.velocity_rad_s); check the "
                "gear ratio",
            )
        velocities = self._velocities
        # A repeated sample must not be counted twice, because the time difference could be zero.
        if not velocities or sample.time > velocities[-1][0]:
            velocities.append((sample.time, sample.velocity))
        # Mean acceleration over the last ticks, dv / dt.
        (start, before) = velocities[0]
        (end, after) = velocities[-1]
        rate = abs(after - before) / (end - start) if len(velocities) > ACCELERATION_TICKS else 0.0
        if rate > config.acceleration_rad_s2:
            return Trip(
                "acceleration",
                f"the shaft accelerated at {rate:.0f} rad/s2, but at most "
                f"{config.acceleration_rad_s2:g} rad/s2 is allowed (safety.acceleration_rad_s2); "
                "check whether something hit the fin",
            )
        error = sample.following_error
        if error is None or abs(error) <= config.following_rad:
            self._followed = None
        elif self._followed is None:
            self._followed = sample.time
        elif sample.time - self._followed > config.following_s:
            return Trip(
                "following",
                f"the shaft has been {error:.3f} rad behind its profile for "
                f"{config.following_s:g} s, but at most {config.following_rad:g} rad is allowed; "
                "check for a blocked fin or a high load",
            )
        return None

    def _check_loads(self, sample: Sample, now: float) -> Trip | None:
        config = self.config
        # Use unfiltered peaks if they are known, because the filter hides short peaks.
        peaks = sample.peak or sample.wrench
        wrench = sample.wrench
        current = () if sample.current is None else (sample.current,)
        for name, unit, largest, values, peak, sustained in (
            ("force", "N", peaks[:3], wrench[:3], config.force_peak_n, config.force_sustained_n),
            (
                "torque",
                "N m",
                peaks[3:],
                wrench[3:],
                config.torque_peak_nm,
                config.torque_sustained_nm,
            ),
            ("current", "A", current, current, config.current_peak_a, config.current_sustained_a),
        ):
            if not values or peak is None or sustained is None:
                continue
            worst = max(map(abs, largest))
            if worst > peak:
                return Trip(
                    f"{name}_peak",
                    f"{name} {worst:.2f} {unit}, but at most {peak:g} {unit} is allowed at any "
                    "time; check whether the fin touches something",
                )
            average = self._means[name].after(now, math.hypot(*values))
            if average > sustained:
                return Trip(
                    f"{name}_sustained",
                    f"{name} {average:.2f} {unit} on average over {SUSTAINED_S:g} s, but "
                    f"at most {sustained:g} {unit} is allowed; reduce the target",
                )
        return None

    def _check_range(self, sample: Sample, now: float) -> Trip | None:
        margin = self.config.training_margin
        if self.trained is None or margin is None:
            return None
        values = {
            "angle": sample.angle,
            "velocity": sample.velocity,
            "force x": sample.wrench[0],
            "force y": sample.wrench[1],
        }
        # Distance from the training range, as a multiple of its width.
        beyond = {
            name: max(bounds[0] - value, value - bounds[1], 0.0) / max(bounds[1] - bounds[0], 1e-6)
            for (name, value), bounds in zip(values.items(), self.trained, strict=True)
            if bounds
        }
        channel = max(beyond, key=beyond.__getitem__, default="")
        average = self._outside.after(now, beyond.get(channel, 0.0))
        if average > margin:
            return Trip(
                "beyond_training",
                f"{channel} was outside the training range of the surrogate by {average:.2f} of "
                f"its width for 1 s, but at most {margin:g} is allowed (safety.training_margin); "
                "fit a surrogate to data with a wider range",
            )
        return None


class _Mean:
    """Moving average over the last `seconds`; 0 until the window is full."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._began: float | None = None
        self._items: deque[tuple[float, float]] = deque()

    def after(self, now: float, value: float) -> float:
        """Add a value at time `now` [s] and return the mean."""
        self._began = now if self._began is None else self._began
        self._items.append((now, value))
        while self._items[0][0] < now - self._seconds:
            self._items.popleft()
        if now - self._began < self._seconds:
            return 0.0
        return sum(value for _, value in self._items) / len(self._items)


def accept_target(target: Target, limits: Limits) -> Target:
    """Return a target within the limits, which the drive enforces exactly; raises CommandError if
    the target is outside by more than rounding errors."""
    if trip := check_target(target, limits):
        raise CommandError(trip.reason)
    low_angle, high_angle, slowest, fastest = limits
    return Target(
        min(max(target.angle, low_angle), high_angle), min(max(target.velocity, slowest), fastest)
    )
