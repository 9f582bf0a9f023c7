"""The hand-shake by which an EPOS2 takes a new target in profile position mode; pure, driven by its statuswords.

Bit 4 of the controlword rises with the target; the drive answers with bit 12 of the statusword; bit 4 falls, then
bit 12 (maxon "EPOS2 Firmware Specification", rel5466). The newest target wins while another is on its way.
"""

from enum import Enum, auto
from typing import NamedTuple


class Setpoint(NamedTuple):
    """A target in the drive's units."""

    counts: int
    rpm: int


class Stage(Enum):
    """Of the hand-shake."""

    IDLE = auto()
    RAISED = auto()
    LOWERED = auto()


class Handshake:
    """Says what to send next; `patience` [s] is how long an answer may take before it is asked for again."""

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._stage, self._since = Stage.IDLE, 0.0
        self._waiting: Setpoint | None = None
        self.current: Setpoint | None = None
        """The one that the drive has, or is being given."""
        self.superseded = self.repeated = 0
        self.unanswered = 0
        """Times in a row that the drive did not acknowledge the current target."""

    def clear(self) -> None:
        """Forget everything: the drive was stopped, or is enabled anew."""
        self._stage, self._waiting, self.current, self.unanswered = Stage.IDLE, None, None, 0

    def offer(self, setpoint: Setpoint) -> None:
        """To be given to the drive as soon as it can take it."""
        self.superseded += self._waiting is not None
        self._waiting = setpoint

    def step(self, acknowledged: bool, now: float) -> Setpoint | bool | None:
        """A target to raise, True to lower bit 4, or None: nothing to send."""
        late = now - self._since > self._patience
        if self._stage is Stage.RAISED and (acknowledged or late):
            return self._answered(acknowledged, now)
        if self._stage is Stage.LOWERED or (self._stage is Stage.IDLE and self._waiting):
            if acknowledged:
                # A drive whose bit 12 does not fall takes no target.
                self._since = now if late else self._since
                self.unanswered += late
                return late or None
            self._stage = Stage.IDLE
        if self._stage is Stage.IDLE and self._waiting and not acknowledged:
            self.current, self._waiting = self._waiting, None
            self._stage, self._since = Stage.RAISED, now
            return self.current
        return None

    def _answered(self, acknowledged: bool, now: float) -> bool:
        self._stage, self._since = Stage.LOWERED, now
        if acknowledged:
            self.unanswered = 0
        else:
            self.unanswered, self.repeated = self.unanswered + 1, self.repeated + 1
            self._waiting = self._waiting or self.current
        return True
