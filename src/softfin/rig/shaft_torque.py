"""The mean torques about the shaft during each action of a controller. No I/O.

The torque on the fin is the torque of the force sensor minus its value at rest. The torque of the
motor is its current times `drive.torque_constant_nm_a`; it also accelerates the rotor, which the
sensor does not see because it is under the motor. Both are positive towards positive angles.
"""

import math
from collections.abc import Sequence

from softfin.core.quantities import RATE_HZ
from softfin.rig.machine import Sample
from softfin.rig.session import Session, Warn

STROKE_RAD = 0.1
"""Motion of the shaft within an action during which a torque must change [rad]."""

JUDGED_S = 60.0
"""Time in motion after which the mean power of a torque must be positive [s], because a fin takes
up power."""


class ShaftTorque:
    """Torques during the actions of one session.

    `warn` is called once if a torque has the wrong sign, and with `is_needed` also if the motor
    current is not used because the torque constant is unknown.
    """

    def __init__(self, session: Session, warn: Warn, is_needed: bool = False) -> None:
        self._session = session
        self._warn = warn
        self._is_needed = is_needed
        self._sensed = _Torque(
            "the torque of the force sensor",
            "correct drive.direction or sensor.frame, or the sign of sensor.scale.torque_z of a "
            "sensor that sends lines",
            warn,
        )
        self._motor = _Torque(
            "the motor current",
            "correct the driver so that the current is positive when the motor pushes the fin "
            "towards positive angles",
            warn,
        )

    def means(self, samples: Sequence[Sample]) -> tuple[float | None, float | None]:
        """Return the mean torque on the fin and of the motor over the samples of an action [N m];
        None if it is not measured, not finite, constant while the shaft moves, or has the wrong
        sign."""
        return (
            self._sensed.mean(self._from_sensor(samples), samples),
            self._motor.mean(self._from_current(samples), samples),
        )

    def _from_sensor(self, samples: Sequence[Sample]) -> list[float]:
        """Return the torque on the fin at each sample [N m]; empty if it is not measured."""
        at_rest = [sample.wrench[-1] for sample in self._session.at_rest]
        torques = [sample.wrench[-1] for sample in samples]
        # Sensors report zero for loads that they do not measure.
        if not any(at_rest) and not any(torques):
            return []
        zero = sum(at_rest) / max(len(at_rest), 1)
        return [torque - zero for torque in torques]

    def _from_current(self, samples: Sequence[Sample]) -> list[float]:
        """Return the torque of the motor at each sample [N m]; empty if it is unknown."""
        currents = [sample.current for sample in samples if sample.current is not None]
        if len(currents) < len(samples):
            return []
        # Only a rig has a configured drive.
        constant_nm_a = getattr(self._session.machine, "torque_constant_nm_a", None)
        if constant_nm_a is not None:
            return [constant_nm_a * current for current in currents]
        if self._is_needed:
            self._is_needed = False
            self._warn(
                "the motor current: not used for feedback because its torque constant is unknown; "
                "set drive.torque_constant_nm_a in the rig file (docs/rig.md)"
            )
        return []


class _Torque:
    """One of the torques, until its sign is found to be wrong."""

    def __init__(self, name: str, sign_fix: str, warn: Warn) -> None:
        self._name = name
        self._sign_fix = sign_fix
        self._warn = warn
        self._is_reversed = False
        self._ticks = 0
        """Number of ticks in motion."""
        self._power_w = 0.0
        """Sum of the power at these ticks [W]."""

    def mean(self, torques: Sequence[float], samples: Sequence[Sample]) -> float | None:
        """Return the mean of the torques of an action [N m], or None if they are unusable."""
        if self._is_reversed or not torques or not all(map(math.isfinite, torques)):
            return None
        angles = [sample.angle for sample in samples]
        if max(angles) - min(angles) > STROKE_RAD:
            if min(torques) == max(torques):
                return None
            self._judge(torques, samples)
        return None if self._is_reversed else sum(torques) / len(torques)

    def _judge(self, torques: Sequence[float], samples: Sequence[Sample]) -> None:
        """Check the sign of the torque."""
        self._ticks += len(samples)
        self._power_w += sum(
            torque * sample.velocity for torque, sample in zip(torques, samples, strict=True)
        )
        mean_w = self._power_w / self._ticks
        if self._ticks >= JUDGED_S * RATE_HZ and mean_w < 0:
            self._is_reversed = True
            self._warn(
                f"{self._name}: opposes the motion of the shaft ({mean_w:.2g} W on average over "
                f"{self._ticks / RATE_HZ:.0f} s of motion), so its sign is wrong and it is no "
                f"longer used; {self._sign_fix}"
            )
