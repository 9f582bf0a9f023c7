"""Inputs to softfin's nodes: the latest reference with a timeout, and the emergency stop. Each note
is reported only once."""

from collections.abc import Callable
from typing import Generic, TypeVar

from softfin.core.errors import DeviceError
from softfin.rig.ros2.connection import BOOL, Quality, Subscription, Transport

InputValue = TypeVar("InputValue")

MAX_REMARKS = 20
"""Maximum number of different notes to report; further notes are dropped."""


class OnceReporter:
    """Reports each note to the user only once."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.report = report
        self._reported: set[str] = set()

    def __call__(self, line: str) -> None:
        """Report a line unless it was reported before or `MAX_REMARKS` lines have been reported."""
        if line not in self._reported and len(self._reported) < MAX_REMARKS:
            self._reported.add(line)
            self.report(line)


class NewestReference(Generic[InputValue]):
    """The latest reference on a topic, until it expires."""

    def __init__(
        self,
        subscription: Subscription[InputValue],
        timeout_s: float | int | None,
        clock: Callable[[], float],
        once: OnceReporter,
    ) -> None:
        """Start without a reference; references expire after `timeout_s` [s], or never if it is
        None."""
        self.subscription = subscription
        self._timeout = timeout_s
        self._clock = clock
        self._once = once
        self._newest: tuple[float, InputValue] | None = None
        self.is_lost = False
        """Whether references were received and the latest one has expired."""

    def newest(self) -> InputValue | None:
        """Return the latest reference; None if there is none or it has expired, which is
        reported."""
        subscription = self.subscription
        topic = subscription.topic
        try:
            self._newest = next(reversed(subscription.take()), self._newest)
        except DeviceError as error:
            self._once(str(error))
        if subscription.refusal is not None:
            self._once(subscription.refusal)
        if subscription.mismatched():
            self._once(
                f"{topic}: messages from a publisher cannot be received; its quality of service "
                "must be reliable, not best effort"
            )
        newest = self._newest
        timeout = self._timeout
        if newest is not None:
            self.is_lost = timeout is not None and self._clock() - newest[0] > timeout
        if newest is not None and self.is_lost:
            self._newest = newest = None
            self._once.report(
                f"{topic}: no reference for {timeout:g} s, so the last one has expired"
            )
        return None if newest is None else newest[1]


QUALITIES: tuple[Quality, ...] = ("reliable", "best_effort", "latched")
"""Qualities of service of the readers of an emergency stop. A reliable reader alone receives
neither messages from a best-effort publisher, such as a radio bridge or a joystick driver, nor a
`true` latched before the node started; DDS reports neither case to the publisher."""


class EmergencyStop:
    """A std_msgs/Bool topic on which `true` or an unreadable message causes a permanent stop."""

    def __init__(self, transport: Transport, topic: str, once: OnceReporter) -> None:
        """Subscribe to the topic; `once` receives notes for the user."""
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
        """Number of unreadable messages; a message reaches several readers but is counted once."""
        return max(subscription.refused for subscription in self._subscriptions.values())

    def reason(self) -> str | None:
        """Return the reason for a permanent stop; None if none was requested."""
        if self._reason is None:
            try:
                self._reason = next(
                    filter(None, map(self._read_stop, self._subscriptions.values())), None
                )
                # Only this reader must match every publisher, because it requests the lowest
                # quality.
                if self._subscriptions["best_effort"].mismatched():
                    problem = (
                        "messages from a publisher cannot be received, so it cannot stop the fin"
                    )
                    self._once(
                        f"{self._topic}: {problem}; use the default quality of service of ROS 2"
                    )
            except DeviceError as error:
                self._reason = f"emergency stop cannot be received: {error}"
        return self._reason

    def _read_stop(self, subscription: Subscription[bool]) -> str | None:
        refused = subscription.refused
        if any(stop for _, stop in subscription.take()):
            return f"emergency stop on {self._topic}"
        # A readable message does not cancel an earlier unreadable one.
        if subscription.refused > refused:
            reason = (
                subscription.refusal or f"{self._topic}: unreadable message; correct its publisher"
            )
            return f"emergency stop: {reason}"
        return None
