"""A machine with its safety limits, rest time and configuration."""

from dataclasses import dataclass, field

from softfin.control.feedback import FeedbackConfig
from softfin.core.errors import RigError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import Limits
from softfin.rig.machine import Machine
from softfin.rig.safety import SafetyConfig


@dataclass(frozen=True)
class RobotSetup:
    """A machine, its safety limits and its configuration."""

    machine: Machine
    safety: SafetyConfig
    fin: str | None = None
    """Name of this fin; None if unknown."""
    settle_s: float = 5.0
    """Rest time before each log or experiment [s]."""
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    """Settings of feedback on this fin."""
    configuration: JsonObject = field(default_factory=dict)
    """Complete configuration for JSON."""

    def check_ready(self) -> None:
        """Raise RigError if the machine has a method `check_ready` and is not ready to move; it
        must be open."""
        check = getattr(self.machine, "check_ready", None)
        if check is not None:
            check()

    def feedback_settings(self, asked: FeedbackConfig | None) -> FeedbackConfig | None:
        """Return the settings of this fin, overridden by the fields that are set in the given ones;
        None for no feedback."""
        if asked is None:
            return None
        return self.feedback.merged(asked.model_dump(exclude_unset=True), "feedback")

    def check_fits(self, controller: str, limits: Limits, fin: str | None) -> None:
        """Raise RigError if a controller is for a different fin or exceeds the limits of the
        machine."""
        if None not in (fin, self.fin) and fin != self.fin:
            raise RigError(
                f"{controller}: trained for fin {fin!r}, but this rig has fin {self.fin!r}; train "
                "a controller for this fin, or correct 'fin' in the rig file"
            )
        for quantity, unit in (("angle", "rad"), ("velocity", "rad/s")):
            (low, high), (lowest, highest) = (
                (getattr(each, f"{quantity}_min"), getattr(each, f"{quantity}_max"))
                for each in (limits, self.machine.limits)
            )
            if low < lowest - 1e-3 or high > highest + 1e-3:
                raise RigError(
                    f"{controller}: commands a {quantity} of {low:.5g} .. {high:.5g} {unit}; "
                    f"{self.machine.name} accepts {lowest:.5g} .. {highest:.5g}; train the "
                    "controller within these limits, or widen the limits of the rig"
                )
