"""softfin as a ROS 2 node: publishes every sample and command, and receives references and the
emergency stop.

All calls are made from the loop's thread; nothing in this module blocks or moves the fin.
"""

import functools
import time
from collections.abc import Callable

from softfin.control.references import controller_cells, reachable_set
from softfin.core.errors import DeviceError, SoftfinError
from softfin.rig.loop import ResolveReference
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.connection import Subscription, Transport, read_reference_message
from softfin.rig.ros2.inputs import EmergencyStop, NewestReference, OnceReporter
from softfin.rig.session import MeasuredForce
from softfin.rig.stop import StopRequest
from softfin.storage.bag.messages import FLOAT, JOINT_STATE, WRENCH_STAMPED, cdr

REFERENCE_LIMIT_N = 20.0
"""Default of `NodeConfig.reference_limit_n` for the paper's fin [N]."""


def default_reference_limit(controller: object) -> float:
    """Return the default of `NodeConfig.reference_limit_n` for a controller [N]."""
    reachable = reachable_set(controller)
    size = 1.0 if reachable is None else reachable.size
    corners = [(*cell.low, *cell.high) for cell in controller_cells(controller)]
    return max([REFERENCE_LIMIT_N * size, *(abs(force) for corner in corners for force in corner)])


class RosNode:
    """Node that connects the loop to other nodes. Unusable messages are counted and ignored."""

    def __init__(
        self,
        transport: Transport,
        topics: NodeConfig,
        report: Callable[[str], None],
        resolve: ResolveReference = lambda force: (force, None),
        clock: Callable[[], float] = time.monotonic,
        default_limit_n: float = REFERENCE_LIMIT_N,
        torque_constant_nm_a: float | None = None,
        emergency_stop: EmergencyStop | None = None,
    ) -> None:
        """Connect. `report` receives each note for the user only once; `resolve` maps a reference
        to the tracked reference; `default_limit_n` applies if `topics` has no limit;
        `torque_constant_nm_a` is None if the motor torque is unknown; `emergency_stop` is None if
        the node reads the stop topic by itself."""
        self.config = topics
        self._limit_n = topics.reference_limit_n or default_limit_n
        self._report_once = OnceReporter(report)
        # References are published repeatedly, so cache the latest result.
        self._resolve = functools.lru_cache(maxsize=1)(resolve)
        self.joint = transport.publish(topics.joint_topic, JOINT_STATE)
        self._wrench = transport.publish(topics.wrench_topic, WRENCH_STAMPED)
        self._command = transport.publish(topics.command_topic, JOINT_STATE)
        self._current = transport.publish(topics.current_topic, FLOAT)
        self._torque_constant = torque_constant_nm_a
        subscription = Subscription(
            transport, topics.reference_topic, WRENCH_STAMPED, self._tracked, stamped=False
        )
        self._references = NewestReference(
            subscription, topics.reference_timeout_s, clock, self._report_once
        )
        # Reject a controller that cannot track 0 N before anything moves.
        self._no_force = resolve((0.0, 0.0))[0] if topics.reference_lost == "zero" else None
        self._stop = emergency_stop or EmergencyStop(
            transport, topics.stop_topic, self._report_once
        )
        self._published: Target | None = None
        self._unsent = 0

    def publish(self, sample: Sample, target: Target | None) -> None:
        """Publish one sample, and the command if it is new, and count samples that cannot be
        sent."""
        frame = self.config.frame
        name = self.config.joint_name
        # Read both clocks at the same time, because the wall clock may be set at any time.
        ahead = time.time_ns() - round(time.monotonic() * 1e9)
        stamp, force_stamp = (round(at * 1e9) + ahead for at in (sample.time, sample.force_time))
        try:
            joint = [sample.angle, sample.velocity]
            if sample.current is not None and self._torque_constant is not None:
                joint.append(self._torque_constant * sample.current)
            self.joint.send(cdr(JOINT_STATE, stamp, joint, frame, name))
            self._wrench.send(cdr(WRENCH_STAMPED, force_stamp, sample.wrench, frame))
            if target is not None and target != self._published:
                self._command.send(cdr(JOINT_STATE, stamp, target, frame, name))
                self._published = target
            if sample.current is not None:
                self._current.send(cdr(FLOAT, stamp, (sample.current,)))
        except DeviceError as error:
            self._unsent += 1
            self._report_once(str(error))

    def reference(self) -> MeasuredForce | None:
        """Return the latest reference; if it has expired, zero force or None, as configured."""
        newest = self._references.newest()
        return self._no_force if newest is None and self._references.is_lost else newest

    def forget_references(self) -> None:
        """Forget the references before this motion."""
        self._references.forget()

    def stop_reason(self) -> str | None:
        """Return the reason for a permanent stop, which may be an unreadable message; None while no
        stop is active."""
        return self._stop.reason()

    def observe(self, request: StopRequest, sample: Sample, target: Target | None) -> None:
        """As an observer of the session, publish a sample and forward stops."""
        reason = self.stop_reason()
        if reason is not None:
            request.ask("emergency_stop", reason)
        # Also receive references here so that their age counts from their arrival, not from the
        # next action.
        self.reference()
        if self._references.is_lost and self.config.reference_lost == "stop":
            # A fin without its robot, radio link or operator must not keep moving.
            topic = self.config.reference_topic
            timeout_s = self.config.reference_timeout_s
            reason = (
                f"{topic}: no reference for {timeout_s:g} s; start its publisher, then restart "
                "this node"
            )
            request.ask("reference_lost", reason)
        self.publish(sample, target)

    def counters(self) -> dict[str, int]:
        """Return the numbers of received references, rejected references and stops, and unsent
        samples."""
        references = self._references.subscription
        return {
            "references": references.received - references.refused,
            "references_refused": references.refused,
            "stops_refused": self._stop.refused,
            "unsent": self._unsent,
        }

    def _tracked(self, message: object) -> MeasuredForce:
        """Return the tracked reference for a message; raises ValueError if it is rejected."""
        force = read_reference_message(message, self.config.frame)
        limit = self._limit_n
        if max(map(abs, force)) > limit:
            raise ValueError(
                f"({force[0]:g}, {force[1]:g}) N exceeds reference_limit_n = {limit:g} N"
            )
        try:
            tracked, warning = self._resolve(force)
        except SoftfinError as error:
            raise ValueError(str(error)) from None
        if warning is not None:
            self._report_once(warning)
        return tracked
