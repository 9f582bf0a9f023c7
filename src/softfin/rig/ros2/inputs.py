"""Inputs to softfin's nodes: the latest reference with a timeout, and the emergency stop. Each note
is reported only once."""

import contextlib
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from softfin.core.errors import DeviceError, RigError
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

    def forget(self) -> None:
        """Forget the references so far, as at the start."""
        with contextlib.suppress(DeviceError):
            self.subscription.take()
        self._newest = None
        self.is_lost = False

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
    """Memory of a stop, which only `reset` clears: a stop on a std_msgs/Bool topic, by `true` or by
    an unreadable message, or a stop for any other reason. Any thread may call its methods."""

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
        self._lock = threading.Lock()
        self._reason: str | None = None
        self._requesting: set[Quality] = set()
        """Readers whose latest message requests a stop."""

    @property
    def refused(self) -> int:
        """Number of unreadable messages; a message reaches several readers but is counted once."""
        return max(subscription.refused for subscription in self._subscriptions.values())

    def reason(self) -> str | None:
        """Return the reason for a permanent stop; None if none was requested."""
        with self._lock:
            if self._reason is None:
                self._reason = self._read_stops()
            return self._reason

    def stop(self, reason: str) -> None:
        """Remember a stop for a reason other than the topic."""
        with self._lock:
            earlier = self._reason or ""
            # The outcome of a stop contains its reason; a repeated stop adds nothing.
            if earlier in reason:
                self._reason = reason
            elif reason not in earlier:
                self._reason = f"{earlier}; {reason}"

    def reset(self) -> None:
        """Forget the stop; raises RigError if the latest message still requests one or if no
        messages can be received."""
        with self._lock:
            # A stop that arrives now must not be lost if the reset is refused.
            self._reason = self._read_stops() or self._reason
            if self._requesting:
                raise RigError(
                    f"{self._topic}: still requests a stop; publish false on it (latched, if the "
                    "stop was), or restart the node"
                )
            self._reason = None

    def _read_stops(self) -> str | None:
        try:
            reasons = [self._read_stop(quality) for quality in QUALITIES]
            # Only this reader must match every publisher, because it requests the lowest quality.
            if self._subscriptions["best_effort"].mismatched():
                problem = "messages from a publisher cannot be received, so it cannot stop the fin"
                self._once(f"{self._topic}: {problem}; use the default quality of service of ROS 2")
        except DeviceError as error:
            self._requesting.update(QUALITIES)
            return f"emergency stop cannot be received: {error}"
        return next(filter(None, reasons), None)

    def _read_stop(self, quality: Quality) -> str | None:
        subscription = self._subscriptions[quality]
        refused = subscription.refused
        stops = [stop for _, stop in subscription.take()]
        if subscription.refusal is not None or (stops and stops[-1]):
            self._requesting.add(quality)
        elif stops:
            self._requesting.discard(quality)
        if any(stops):
            return f"emergency stop on {self._topic}"
        # A readable message does not cancel an earlier unreadable one.
        if subscription.refused > refused:
            reason = (
                subscription.refusal or f"{self._topic}: unreadable message; correct its publisher"
            )
            return f"emergency stop: {reason}"
        return None
