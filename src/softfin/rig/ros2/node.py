"""softfin as a ROS 2 node: every sample and command goes out as messages; references and the emergency stop come in.

Called by the thread of the loop; nothing here waits, and nothing here moves the fin.
"""

import time
from collections.abc import Callable

from softfin.core.errors import DeviceError, SoftfinError
from softfin.rig.loop import Force, References, ResolveReference
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.connection import Stamped, Subscription
from softfin.rig.ros2.messages import BOOL, JOINT, VECTOR, WRENCH, Messages, reference_of
from softfin.rig.ros2.transport import Transport
from softfin.rig.session import Observer
from softfin.rig.stop import StopRequest

MOST_LINES = 20
"""Most different lines that are reported."""


class RosNode:
    """Between the loop and other nodes. An unusable message is counted, never obeyed."""

    def __init__(
        self, transport: Transport, topics: NodeConfig, report: Callable[[str], None],
        resolve: ResolveReference = lambda force: (force, None), clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """`report` gets remarks for the user, each once; `resolve` maps a reference to the one that is tracked."""
        self.config, self._clock, self._resolve, self._report = topics, clock, resolve, report
        self._messages = messages = Messages()
        self.joint = transport.publish(topics.joint_topic, JOINT)
        self._wrench = transport.publish(topics.wrench_topic, WRENCH)
        self._command = transport.publish(topics.command_topic, JOINT)
        kind = WRENCH if topics.reference_type == "wrench" else VECTOR
        self._references: Subscription[Force] = Subscription(
            transport, messages, topics.reference_topic, kind, self._tracked, stamped=False
        )
        self._stops: Subscription[bool] = Subscription(
            transport, messages, topics.stop_topic, BOOL, lambda message: bool(message.data), stamped=False
        )
        self._newest: Stamped[Force] | None = None
        self._resolved: tuple[Force, Force] | None = None
        """The newest reference that was asked for, and the one that is tracked."""
        self._published: Target | None = None
        self._stop: str | None = None
        self._reported: set[str] = set()
        self._unsent = 0

    def publish(self, sample: Sample, target: Target | None) -> None:
        """Publish one sample, and the command where it is a new one; what cannot go out is counted."""
        config, messages = self.config, self._messages
        # Both clocks at the same moment: this computer's date may be set at any time.
        ahead = time.time_ns() - round(time.monotonic() * 1e9)
        stamp, force_stamp = (round(at * 1e9) + ahead for at in (sample.time, sample.force_time))
        joint = messages.joint(stamp, config.frame, config.joint_name, sample.angle, sample.velocity)
        try:
            self.joint.send(messages.encode(joint))
            self._wrench.send(messages.encode(messages.wrench(force_stamp, config.frame, sample.wrench)))
            if target is not None and target != self._published:
                command = messages.joint(stamp, config.frame, config.joint_name, target.angle, target.velocity)
                self._command.send(messages.encode(command))
                self._published = target
        except DeviceError as error:
            self._unsent += 1
            self._report_once(str(error))

    def reference(self) -> Force | None:
        """The newest reference that counts; None where none has come, or the newest is too old."""
        try:
            self._newest = next(reversed(self._references.take()), self._newest)
        except DeviceError as error:
            self._report_once(str(error))
        if self._references.refusal is not None:
            self._report_once(self._references.refusal)
        newest, timeout = self._newest, self.config.reference_timeout_s
        if newest is not None and timeout is not None and self._clock() - newest.received > timeout:
            self._newest = newest = None
            topic = self.config.reference_topic
            self._report(f"{topic}: no reference for {timeout:g} s: the last one does not count any more")
        return None if newest is None else newest.value

    def stop_reason(self) -> str | None:
        """Why to stop, for good; None where nobody has asked for it. An unreadable message stops, too."""
        if self._stop is None:
            try:
                if any(stop.value for stop in self._stops.take()):
                    self._stop = f"emergency stop on {self.config.stop_topic}"
                elif self._stops.refusal is not None:
                    self._stop = f"emergency stop: {self._stops.refusal}"
            except DeviceError as error:
                self._stop = f"emergency stop cannot be heard: {error}"
        return self._stop

    def references(self, otherwise: Force) -> References:
        """References for the loop: the newest that counts, else a constant one."""
        return lambda _: self.reference() or otherwise

    def observer(self, request: StopRequest) -> Observer:
        """An observer of the session: publishes each sample, and passes on a stop."""

        def observe(sample: Sample, target: Target | None) -> None:
            reason = self.stop_reason()
            if reason is not None:
                request.ask("emergency_stop", reason)
            # Taken here too, so that its age counts from when it came, not from the next action.
            self.reference()
            self.publish(sample, target)

        return observe

    def counters(self) -> dict[str, int]:
        """Counts of references and stops that came and were refused, and of samples that did not go out."""
        return {
            "references": self._references.received - self._references.refused,
            "references_refused": self._references.refused,
            "stops_refused": self._stops.refused,
            "unsent": self._unsent,
        }

    def _tracked(self, message: object) -> Force:
        """The reference that is tracked for a message; raises ValueError where it is refused."""
        force, limit = reference_of(message, self.config.frame), self.config.reference_limit_n
        if max(map(abs, force)) > limit:
            raise ValueError(f"it is ({force[0]:g}, {force[1]:g}) N; reference_limit_n is {limit:g} N")
        if self._resolved is None or force != self._resolved[0]:
            try:
                tracked, warning = self._resolve(force)
            except SoftfinError as error:
                raise ValueError(str(error)) from None
            self._resolved = force, tracked
            if warning is not None:
                self._report_once(warning)
        return self._resolved[1]

    def _report_once(self, line: str) -> None:
        """Report a line that was not there before; many different ones are only counted."""
        if line not in self._reported and len(self._reported) < MOST_LINES:
            self._reported.add(line)
            self._report(line)
