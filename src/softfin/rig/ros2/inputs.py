"""Inputs of softfin's nodes: the newest reference with a timeout, the emergency stop; and remarks,
each once."""

from collections.abc import Callable
from typing import Generic, TypeVar

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import BOOL, Quality, Subscription, Transport

InputValue = TypeVar("InputValue")

MAX_REMARKS = 20
"""Different remarks that are reported; more are only counted."""


class OnceReporter:
    """Reports remarks for the user, each once."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.report = report
        self._reported: set[str] = set()

    def __call__(self, line: str) -> None:
        """Report a line that was not there before; many different ones are dropped."""
        if line not in self._reported and len(self._reported) < MAX_REMARKS:
            self._reported.add(line)
            self.report(line)


class NewestReference(Generic[InputValue]):
    """The newest reference of a topic, for as long as it counts."""

    def __init__(
        self,
        subscription: Subscription[InputValue],
        timeout_s: float | int | None,
        clock: Callable[[], float],
        once: OnceReporter,
    ) -> None:
        """`timeout_s` is the age beyond which a reference does not count any more [s]; None:
        never."""
        self.subscription = subscription
        self._timeout = timeout_s
        self._clock = clock
        self._once = once
        self._newest: tuple[float, InputValue] | None = None
        self.is_lost = False
        """Whether references came, and the newest is too old."""

    def newest(self) -> InputValue | None:
        """The newest reference that counts; None where none has come, or the newest is too old,
        which is reported."""
        try:
            self._newest = next(reversed(self.subscription.take()), self._newest)
        except DeviceError as error:
            self._once(str(error))
        if self.subscription.refusal is not None:
            self._once(self.subscription.refusal)
        if self.subscription.mismatched():
            topic = self.subscription.topic
            self._once(
                f"{topic}: a publisher cannot be received; it must be reliable, not best effort"
            )
        newest = self._newest
        timeout = self._timeout
        if newest is not None:
            self.is_lost = timeout is not None and self._clock() - newest[0] > timeout
        if newest is not None and self.is_lost:
            self._newest = newest = None
            topic = self.subscription.topic
            self._once.report(f"{topic}: no reference for {timeout:g} s: the last one has expired")
        return None if newest is None else newest[1]


QUALITIES: tuple[Quality, ...] = ("reliable", "best_effort", "latched")
"""Readers of an emergency stop. A reliable one alone is deaf to a best-effort publisher, such as a
radio bridge or a joystick's driver, and to a `true` that was latched before the node started; DDS
reports neither to the publisher."""


class EmergencyStop:
    """A topic of std_msgs/Bool on which true is a stop for good; a message that cannot be read is
    one, too."""

    def __init__(self, transport: Transport, topic: str, once: OnceReporter) -> None:
        """`once` gets remarks for the user."""
        self._topic = topic
        self._once = once
        self._subscriptions = {
            quality: Subscription(
                transport, topic, BOOL, lambda message: message.data, stamped=False, quality=quality
            )
            for quality in QUALITIES
        }
        self._reason: str | None = None

    @property
    def refused(self) -> int:
        """Number of messages that could not be read; each comes to several readers and counts
        once."""
        return max(subscription.refused for subscription in self._subscriptions.values())

    def reason(self) -> str | None:
        """Reason to stop for good; None where nobody has asked for it."""
        if self._reason is None:
            try:
                self._reason = next(
                    filter(None, map(self._read_stop, self._subscriptions.values())), None
                )
                # The other readers do not match every publisher, and need not: this one asks for
                # the least.
                if self._subscriptions["best_effort"].mismatched():
                    problem = "a publisher cannot be received, so it cannot stop the fin"
                    self._once(
                        f"{self._topic}: {problem}; give it ROS 2's default quality of service"
                    )
            except DeviceError as error:
                self._reason = f"emergency stop cannot be heard: {error}"
        return self._reason

    def _read_stop(self, subscription: Subscription[bool]) -> str | None:
        refused = subscription.refused
        if any(stop for _, stop in subscription.take()):
            return f"emergency stop on {self._topic}"
        # A readable message after it does not take an unreadable one back.
        if subscription.refused > refused:
            reason = (
                subscription.refusal
                or f"{self._topic}: a message cannot be read; correct its publisher"
            )
            return f"emergency stop: {reason}"
        return None
