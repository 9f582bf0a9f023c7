"""softfin as a ROS 2 node: every sample and command goes out as messages; references and the
emergency stop come in.

Called by the thread of the loop; nothing here waits, and nothing here moves the fin.
"""

import functools
import time
from collections.abc import Callable

from softfin.core.errors import DeviceError, SoftfinError
from softfin.rig.loop import ResolveReference
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.connection import VECTOR, Subscription, Transport, read_reference_message
from softfin.rig.ros2.inputs import EmergencyStop, NewestReference, OnceReporter
from softfin.rig.session import MeasuredForce
from softfin.rig.stop import StopRequest
from softfin.storage.bag.messages import JOINT_STATE, WRENCH_STAMPED, cdr


class RosNode:
    """Between the loop and other nodes. An unusable message is counted, never obeyed."""

    def __init__(
        self,
        transport: Transport,
        topics: NodeConfig,
        report: Callable[[str], None],
        resolve: ResolveReference = lambda force: (force, None),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`report` gets remarks for the user, each once; `resolve` maps a reference to the one that
        is tracked."""
        self.config = topics
        self._report_once = OnceReporter(report)
        # References are published again and again: the newest one is kept.
        self._resolve = functools.lru_cache(maxsize=1)(resolve)
        self.joint = transport.publish(topics.joint_topic, JOINT_STATE)
        self._wrench = transport.publish(topics.wrench_topic, WRENCH_STAMPED)
        self._command = transport.publish(topics.command_topic, JOINT_STATE)
        kind = WRENCH_STAMPED if topics.reference_type == "wrench" else VECTOR
        subscription = Subscription(
            transport, topics.reference_topic, kind, self._tracked, stamped=False
        )
        self._references = NewestReference(
            subscription, topics.reference_timeout_s, clock, self._report_once
        )
        # A controller that cannot make it is refused before anything moves.
        self._no_force = resolve((0.0, 0.0))[0] if topics.reference_lost == "zero" else None
        self._stop = EmergencyStop(transport, topics.stop_topic, self._report_once)
        self._published: Target | None = None
        self._unsent = 0

    def publish(self, sample: Sample, target: Target | None) -> None:
        """Publish one sample, and the command where it is a new one; what cannot go out is
        counted."""
        frame = self.config.frame
        name = self.config.joint_name
        # Both clocks at the same moment: this computer's date may be set at any time.
        ahead = time.time_ns() - round(time.monotonic() * 1e9)
        stamp, force_stamp = (round(at * 1e9) + ahead for at in (sample.time, sample.force_time))
        try:
            self.joint.send(cdr(JOINT_STATE, stamp, (sample.angle, sample.velocity), frame, name))
            self._wrench.send(cdr(WRENCH_STAMPED, force_stamp, sample.wrench, frame))
            if target is not None and target != self._published:
                self._command.send(cdr(JOINT_STATE, stamp, target, frame, name))
                self._published = target
        except DeviceError as error:
            self._unsent += 1
            self._report_once(str(error))

    def reference(self) -> MeasuredForce | None:
        """The newest reference that counts; where it is too old, no force or None, as
        configured."""
        newest = self._references.newest()
        return self._no_force if newest is None and self._references.is_lost else newest

    def stop_reason(self) -> str | None:
        """Reason to stop for good; None where nobody has asked for it. An unreadable message stops,
        too."""
        return self._stop.reason()

    def observe(self, request: StopRequest, sample: Sample, target: Target | None) -> None:
        """Publish a sample, and pass on a stop: as an observer of the session."""
        reason = self.stop_reason()
        if reason is not None:
            request.ask("emergency_stop", reason)
        # Taken here too, so that its age counts from when it came, not from the next action.
        self.reference()
        if self._references.is_lost and self.config.reference_lost == "stop":
            # A fin whose robot, radio or operator is gone must not go on swimming.
            topic = self.config.reference_topic
            timeout_s = self.config.reference_timeout_s
            reason = (
                f"{topic}: no reference for {timeout_s:g} s; start its publisher, then this node "
                "again"
            )
            request.ask("reference_lost", reason)
        self.publish(sample, target)

    def counters(self) -> dict[str, int]:
        """Counts of references and stops that came and were refused, and of samples that did not go
        out."""
        references = self._references.subscription
        return {
            "references": references.received - references.refused,
            "references_refused": references.refused,
            "stops_refused": self._stop.refused,
            "unsent": self._unsent,
        }

    def _tracked(self, message: object) -> MeasuredForce:
        """The reference that is tracked for a message; raises ValueError where it is refused."""
        force = read_reference_message(message, self.config.frame)
        limit = self.config.reference_limit_n
        if max(map(abs, force)) > limit:
            raise ValueError(
                f"it is ({force[0]:g}, {force[1]:g}) N; reference_limit_n is {limit:g} N"
            )
        try:
            tracked, warning = self._resolve(force)
        except SoftfinError as error:
            raise ValueError(str(error)) from None
        if warning is not None:
            self._report_once(warning)
        return tracked
