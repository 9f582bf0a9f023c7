"""Inputs of softfin's nodes: the newest reference with a timeout, the emergency stop; and remarks, each once."""

from collections.abc import Callable
from typing import Generic, TypeVar

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import BOOL, Subscription, Transport

Value = TypeVar("Value")

MOST_REMARKS = 20
"""Different remarks that are reported; more are only counted."""


class OnceReporter:
    """Reports remarks for the user, each once."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.report = report
        self._reported: set[str] = set()

    def __call__(self, line: str) -> None:
        """Report a line that was not there before; many different ones are dropped."""
        if line not in self._reported and len(self._reported) < MOST_REMARKS:
            self._reported.add(line)
            self.report(line)


class NewestReference(Generic[Value]):
    """The newest reference of a topic, for as long as it counts."""

    def __init__(
        self, subscription: Subscription[Value], timeout_s: float | int | None, clock: Callable[[], float],
        once: OnceReporter,
    ) -> None:  # fmt: skip
        """`timeout_s` is the age beyond which a reference does not count any more [s]; None: never."""
        self.subscription, self._timeout, self._clock, self._once = subscription, timeout_s, clock, once
        self._newest: tuple[float, Value] | None = None

    def newest(self) -> Value | None:
        """The newest reference that counts; None where none has come, or the newest is too old, which is reported."""
        try:
            self._newest = next(reversed(self.subscription.take()), self._newest)
        except DeviceError as error:
            self._once(str(error))
        if self.subscription.refusal is not None:
            self._once(self.subscription.refusal)
        newest, timeout = self._newest, self._timeout
        if newest is not None and timeout is not None and self._clock() - newest[0] > timeout:
            self._newest = newest = None
            topic = self.subscription.topic
            self._once.report(f"{topic}: no reference for {timeout:g} s: the last one does not count any more")
        return None if newest is None else newest[1]


class EmergencyStop:
    """A topic of std_msgs/Bool on which true is a stop for good; a message that cannot be read is one, too."""

    def __init__(self, transport: Transport, topic: str) -> None:
        self.subscription = Subscription(transport, topic, BOOL, lambda message: message.data, stamped=False)
        self._reason: str | None = None

    def reason(self) -> str | None:
        """Reason to stop for good; None where nobody has asked for it."""
        if self._reason is None:
            try:
                if any(stop for _, stop in self.subscription.take()):
                    self._reason = f"emergency stop on {self.subscription.topic}"
                elif self.subscription.refusal is not None:
                    self._reason = f"emergency stop: {self.subscription.refusal}"
            except DeviceError as error:
                self._reason = f"emergency stop cannot be heard: {error}"
        return self._reason
