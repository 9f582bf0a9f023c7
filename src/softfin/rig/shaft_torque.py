"""The mean torque of the motor about the shaft during each action of a controller. No I/O.

It is the torque of the force sensor minus its value at rest or, if the sensor does not measure
torque, the motor current times `drive.torque_constant_nm_a`. Only the current includes the torque
that accelerates the rotor, because the sensor is under the motor.
"""

import math
from collections.abc import Sequence
from typing import Literal

from softfin.core.quantities import RATE_HZ
from softfin.rig.machine import Sample, torque_constant
from softfin.rig.session import Session, Warn

STROKE_RAD = 0.1
"""Motion of the shaft within an action during which the torque must change [rad]."""

JUDGED_S = 60.0
"""Time in motion after which the mean power of the motor must be positive [s], because a fin takes
up power."""

Source = Literal["force sensor", "motor current"]

SIGN_FIXES: dict[Source, str] = {
    "force sensor": (
        "correct drive.direction or sensor.frame, or the sign of sensor.scale.torque_z of a sensor "
        "that sends lines"
    ),
    "motor current": (
        "correct the driver so that the current is positive when the motor pushes the fin towards "
        "positive angles"
    ),
}
"""Fix for a torque with the wrong sign."""


class ShaftTorque:
    """Torque during the actions of one session.

    `warn` is called once if the torque has the wrong sign. With `is_needed`, it is also called if
    the motor current is not used because the torque constant is unknown.
    """

    def __init__(self, session: Session, warn: Warn, is_needed: bool = False) -> None:
        self._session = session
        self._warn = warn
        self._is_needed = is_needed
        self._is_reversed = False
        self._ticks = 0
        """Number of ticks in motion."""
        self._power_w = 0.0
        """Sum of the power at these ticks [W]."""

    def mean(self, samples: Sequence[Sample]) -> float | None:
        """Return the mean torque over the samples of an action [N m], positive towards positive
        angles; None if the torque is not measured, not finite, constant while the shaft moves, or
        has the wrong sign."""
        if self._is_reversed:
            return None
        source, torques = self._measure(samples)
        if not torques or not all(map(math.isfinite, torques)):
            return None
        angles = [sample.angle for sample in samples]
        if max(angles) - min(angles) > STROKE_RAD:
            if min(torques) == max(torques):
                return None
            self._judge(source, torques, samples)
        return None if self._is_reversed else sum(torques) / len(torques)

    def _measure(self, samples: Sequence[Sample]) -> tuple[Source, list[float]]:
        """Return the torque at each sample [N m]; empty if it is not measured."""
        at_rest = [sample.wrench[-1] for sample in self._session.at_rest]
        torques = [sample.wrench[-1] for sample in samples]
        # Sensors report zero for loads that they do not measure.
        if any(at_rest) or any(torques):
            zero = sum(at_rest) / max(len(at_rest), 1)
            return "force sensor", [torque - zero for torque in torques]
        return "motor current", self._convert(samples)

    def _convert(self, samples: Sequence[Sample]) -> list[float]:
        """Return the torque of the motor current at each sample [N m]; empty if it is unknown."""
        currents = [sample.current for sample in samples if sample.current is not None]
        if len(currents) < len(samples):
            return []
        constant_nm_a = torque_constant(self._session.machine)
        if constant_nm_a is not None:
            return [constant_nm_a * current for current in currents]
        if self._is_needed:
            self._is_needed = False
            self._warn(
                "torque feedback: the motor current is not used because the torque constant is "
                "unknown; set drive.torque_constant_nm_a in the rig file (docs/rig.md)"
            )
        return []

    def _judge(self, source: Source, torques: list[float], samples: Sequence[Sample]) -> None:
        """Check the sign of the torque."""
        self._ticks += len(samples)
        self._power_w += sum(
            torque * sample.velocity for torque, sample in zip(torques, samples, strict=True)
        )
        mean_w = self._power_w / self._ticks
        if self._ticks >= JUDGED_S * RATE_HZ and mean_w < 0:
            self._is_reversed = True
            self._warn(
                f"torque about the shaft: according to the {source}, the fin drives the motor "
                f"({mean_w:.2g} W on average over {self._ticks / RATE_HZ:.0f} s of motion), so the "
                f"sign is wrong and the torque is no longer used; {SIGN_FIXES[source]}"
            )
