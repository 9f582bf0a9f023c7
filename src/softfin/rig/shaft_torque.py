"""The mean torques about the shaft and their power during each action of a controller. No I/O.

The torque on the fin is the reading of the force/torque sensor minus its value at rest. The torque
of the motor is the motor current times `drive.torque_constant_nm_a`. It includes the torque that
accelerates the rotor, which the sensor under the motor does not measure. Both torques are positive
towards positive angles.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.rig.machine import WRENCH_CHANNELS, Sample, torque_constant
from softfin.rig.session import MeasuredForce, Session, Warn

STROKE_RAD = 0.1
"""Shaft motion within an action above which a constant torque reading is rejected [rad]."""

UNMEASURED_ACTIONS = 12
"""Number of actions without any torque after which feedback from torque is reported to be
impossible."""

SATURATED_REPEATS = 4
"""Number of times that a reading repeats its predecessor within an action at which a channel is
treated as saturated; the noise of a sensor makes this unlikely."""

ROUNDING = 1e-6
"""Difference of equal values after a filter, as a fraction of their range [-]."""

JUDGED_S = 60.0
"""Time in motion after which the mean power of a torque must be positive [s], because the fin
absorbs power."""

_Series: TypeAlias = Float[np.ndarray, " samples"]

Drive: TypeAlias = tuple[float, float]
"""Mean torque [N m] and mean power [W]; the power is positive if the drive delivers power."""


class ShaftTorque:
    """Torques during the actions of one session.

    `warn` is called once per torque with the wrong sign. With feedback, it is also called once per
    saturated channel, and if the motor current cannot be used because the torque constant is
    unknown, or if feedback needs a torque and none is measured.
    """

    def __init__(self, session: Session, warn: Warn, uses: str | None = None) -> None:
        """Start; `uses` is `FeedbackConfig.uses`, or None without feedback."""
        self._session = session
        self._warn = warn
        self._uses = uses
        self._is_missing = uses == "torque"
        """Whether feedback needs a torque and none has been measured yet."""
        self._actions = 0
        self._reported: set[str] = set()
        """Topics on which `warn` has been called."""
        self._delayed: list[_Series] = []
        """Effect of the delay on the mean force of the last actions [N]."""
        self._sensed = _Torque(
            "the torque of the force sensor",
            "correct drive.direction or sensor.frame, or, for a sensor that sends lines, the sign "
            "of sensor.scale.torque_z",
            warn,
        )
        self._motor = _Torque(
            "the motor current",
            "correct the driver so that the current is positive when the motor drives the fin "
            "towards positive angles",
            warn,
        )

    def start(self) -> None:
        """Forget the forces of the previous experiment."""
        self._delayed = []

    def force(self, samples: Sequence[Sample], window_actions: int) -> MeasuredForce:
        """Return the mean force (x, y) over the samples of an action [N], corrected for the delay
        of the sensor; the mean over a window stays that of the readings. With feedback, a saturated
        force is NaN."""
        rows = [(each.time, each.force_time, *each.wrench[:2]) for each in samples]
        time, force_time, *forces = np.array(rows, float).T
        read = np.mean(forces, axis=1)
        corrected = np.mean([on_time(time, force_time, values) for values in forces], axis=1)
        self._delayed = [*self._delayed, read - corrected][-window_actions:]
        means = corrected + np.mean(self._delayed, axis=0)
        for axis, values in enumerate(forces):
            if self._uses and self._is_saturated(WRENCH_CHANNELS[axis], force_time, values):
                means[axis] = math.nan
        x, y = means.tolist()
        return x, y

    def means(self, samples: Sequence[Sample]) -> tuple[Drive | None, Drive | None]:
        """Return the mean torque and power over the samples of an action, first on the fin, then of
        the motor. None if the torque is not measured, is not finite, is constant while the shaft
        moves, is saturated, or has the wrong sign."""
        rows = [
            (each.time, each.angle, each.velocity, each.force_time, each.wrench[-1], each.current)
            for each in samples
        ]
        # NaN if the current is not measured.
        time, angle, velocity, force_time, torque, current = np.array(rows, float).T
        at_rest = [sample.wrench[-1] for sample in self._session.at_rest]
        # Sensors report zero for loads that they do not measure.
        if not any(at_rest) and not torque.any():
            torque[:] = math.nan
        torque -= np.mean(at_rest or [0.0])
        is_moving = bool(np.ptp(angle) > STROKE_RAD)
        if is_moving:
            for channel in (torque, current):
                if channel.min() == channel.max():
                    channel[:] = math.nan
        if self._uses and self._is_saturated("torque_z", force_time, torque):
            torque[:] = math.nan
        torque = on_time(time, force_time, torque)
        # Currents are means over the time since the previous sample.
        between = np.interp(time - TICK_S / 2, time, velocity)
        shaft = self._sensed.mean(torque, velocity, is_moving)
        motor = self._motor.mean(self._constant(current) * current, between, is_moving)
        self._actions += 1
        self._is_missing = self._is_missing and shaft is None and motor is None
        if self._is_missing and self._actions >= UNMEASURED_ACTIONS:
            self._report(
                "missing",
                "feedback.uses = torque: no torque is measured, so feedback has only the shaft "
                "angle and can correct little; set drive.torque_constant_nm_a in the rig file, use "
                "a sensor that measures the torque about the shaft, or use --feedback.uses force",
            )
        return shaft, motor

    def _report(self, topic: str, line: str) -> None:
        """Warn about a topic, if feedback is on, and only once."""
        if self._uses is not None and topic not in self._reported:
            self._reported.add(topic)
            self._warn(line)

    def _is_saturated(self, name: str, time: _Series, values: _Series) -> bool:
        """Return whether a channel of the force sensor keeps its value for a part of an action.

        Currents need no such check: at the limit of the drive, they are still right.
        """
        values = values[np.diff(time, prepend=-math.inf) > 0]
        span = np.ptp(values)
        is_equal = np.abs(np.diff(values, prepend=math.nan)) <= ROUNDING * span
        repeats = np.convolve(is_equal, np.ones(SATURATED_REPEATS), "valid")
        # Channels that are constant throughout are frozen or not measured.
        is_saturated = bool(span > 0 and repeats.max() == SATURATED_REPEATS)
        if is_saturated:
            self._report(
                name,
                f"{name}: saturated at {values[repeats.argmax()]:.3g}, so feedback does not use it "
                "meanwhile; use a sensor with a larger range, or lower references",
            )
        return is_saturated

    def _constant(self, current: _Series) -> float:
        """Return the torque constant [N m/A]; NaN if it is unknown."""
        constant_nm_a = torque_constant(self._session.machine)
        if constant_nm_a is not None:
            return constant_nm_a
        if np.isfinite(current).any():
            # Otherwise, both lines would ask for the torque constant.
            self._is_missing = False
            self._report(
                "constant",
                "the motor current: not used for feedback, because the torque constant is unknown; "
                "set drive.torque_constant_nm_a in the rig file (docs/rig.md)",
            )
        return math.nan


def on_time(time: _Series, force_time: _Series, values: _Series) -> _Series:
    """Interpolate sensor values at the times of the samples.

    The filters of the sensor delay its values, so none are available for the last samples. These
    samples use the newest value, because the fin takes even longer to respond to a command.
    """
    return np.asarray(np.interp(time, force_time, values))


class _Torque:
    """One of the torques; not used any more once its sign is found to be wrong."""

    def __init__(self, name: str, sign_fix: str, warn: Warn) -> None:
        self._name = name
        self._sign_fix = sign_fix
        self._warn = warn
        self._is_reversed = False
        self._ticks = 0
        """Number of ticks in motion."""
        self._power_w = 0.0
        """Sum of the power at these ticks [W]."""

    def mean(self, torque: _Series, velocity: _Series, is_moving: bool) -> Drive | None:
        """Return the mean torque and power over the samples of an action; None if the torque is
        unusable."""
        if self._is_reversed or not np.isfinite(torque).all():
            return None
        power_w = torque * velocity
        if is_moving:
            self._check_sign(power_w)
        return None if self._is_reversed else (float(torque.mean()), float(power_w.mean()))

    def _check_sign(self, power_w: _Series) -> None:
        """Warn and disable the torque if its mean power over a long motion is negative."""
        self._ticks += len(power_w)
        self._power_w += power_w.sum()
        mean_w = self._power_w / self._ticks
        if self._ticks >= JUDGED_S * RATE_HZ and mean_w < 0:
            self._is_reversed = True
            self._warn(
                f"{self._name}: opposes the motion of the shaft ({mean_w:.2g} W on average over "
                f"{self._ticks / RATE_HZ:.0f} s of motion), so its sign is wrong and it is no "
                f"longer used; {self._sign_fix}"
            )
