"""The ROS 2 node of a robot, which converts a target wrench to one reference force for the node of
each fin. NumPy only.

Each fin is a separate `softfin ros2` process with its own session, safety limits and recording.
This node does not move anything itself: it allocates the wrench to the fins, monitors whether they
are alive, and forwards the emergency stop.
"""

import contextlib
import itertools
from collections.abc import Callable

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError, SafetyStop
from softfin.rig.machine import Wrench
from softfin.rig.pace import Pace
from softfin.rig.ros2.config import check_names, fin_topics
from softfin.rig.ros2.connection import (
    BOOL,
    Publisher,
    Subscription,
    Transport,
    check_frame,
    read_wrench,
)
from softfin.rig.ros2.inputs import EmergencyStop, NewestReference, OnceReporter
from softfin.rig.stop import StopRequest
from softfin.robot.description import WRENCH_AXES, RobotConfig, max_thrust_per_fin
from softfin.robot.node_config import RobotNodeConfig
from softfin.robot.references import NODE_CLOCK, FinReferences
from softfin.storage.bag.messages import JOINT_STATE, WRENCH_STAMPED, cdr, serialized

STOPPING_S = 3.0
"""Maximum time for which stop messages are sent until the fins are silent [s]; a fin brakes and
powers off within one or two seconds."""

QUIET_S = 0.5
"""Time without messages after which a fin that received a stop is treated as stopped [s]."""

WRENCH_LIMIT = 1e6
"""Magnitude above which a wrench is rejected as invalid [N, N m]."""


class FinTopics:
    """Topics of the node of one fin that this node uses."""

    def __init__(self, transport: Transport, name: str, prefix: str) -> None:
        self.name = name
        topics = fin_topics(name, prefix)
        self.joint_topic = topics["joint_topic"]
        self.stop_topic = topics["stop_topic"]
        self.reference_topic = topics["reference_topic"]
        self.reference: Publisher = transport.publish(self.reference_topic, WRENCH_STAMPED)
        self.stop: Publisher = transport.publish(self.stop_topic, BOOL)
        # Stamps are not used because any message shows that the fin is alive; the safety limits of
        # the fin check the age of its readings.
        self._joint = Subscription(
            transport, self.joint_topic, JOINT_STATE, lambda message: None, stamped=False
        )
        self.last_s: float | None = None
        """Time of the latest message from the fin [s]; None before the first message."""

    def listen(self) -> None:
        """Process received messages; raises DeviceError if no more messages can be received."""
        if taken := self._joint.take():
            self.last_s = taken[-1][0]

    def is_silent(self, now: float | int, timeout_s: float | int) -> bool:
        """Return whether no message has been received for `timeout_s` at time `now` [s]."""
        return self.last_s is None or now - self.last_s > timeout_s

    def missing(self) -> list[str]:
        """Return one message per topic that has no node at the other end."""
        found = [] if self.last_s is not None else [f"no publisher on {self.joint_topic}"]
        topics = ((self.reference_topic, self.reference), (self.stop_topic, self.stop))
        return found + [
            f"no subscriber on {topic}" for topic, publisher in topics if not publisher.readers()
        ]


class RobotNode:
    """Node that converts wrenches to references for the fins once per action until it is
    stopped."""

    def __init__(
        self,
        transport: Transport,
        robot: RobotConfig,
        config: RobotNodeConfig,
        report: Callable[[str], None],
        clock: Clock = REAL,
    ) -> None:
        """`report` receives notes for the user; raises InputError if robot and configuration do not
        match."""
        self._references = FinReferences(robot, max_thrust_per_fin(robot, config.max_thrust))
        check_topics(robot, config)
        self.robot = robot
        self.config = config
        self._clock = clock
        self._once = OnceReporter(report)
        self.fins = [FinTopics(transport, name, config.fin_prefix) for name in robot.fins]
        self._achieved = transport.publish(config.wrench_topic, WRENCH_STAMPED)
        self._saturated = transport.publish(config.saturated_topic, BOOL)
        wrenches = Subscription(
            transport, config.reference_topic, WRENCH_STAMPED, self._read, stamped=False
        )
        self._wrenches = NewestReference(wrenches, config.reference_timeout_s, clock, self._once)
        self._stop = EmergencyStop(transport, config.stop_topic, self._once)

    def run(self, request: StopRequest) -> None:
        """Wait for the fins, then send references until a stop; always send a stop to every fin at
        the end.

        Raises:
            SafetyStop: If a stop was requested, wrenches ended and `reference_lost` is stop, or a
                fin is silent and `silent_fin` is stop.
            DeviceError: If not all fins were found within `wait_s`.
        """
        pace = Pace(self._clock)
        try:
            self._await_fins(pace, request)
            self._once.report(
                f"{self.robot.name}: accepts wrenches on {self.config.reference_topic}"
            )
            # 33, 33 and 34 ticks: three actions per second.
            for ticks in itertools.cycle(NODE_CLOCK.ticks):
                self.send_references()
                for _ in range(ticks):
                    pace.wait()
                    self.watch(request)
        finally:
            # Stopping takes up to STOPPING_S and must not be interrupted by a second Ctrl-C.
            request.is_obeyed = True
            self._stop_fins(pace)

    def send_references(self) -> None:
        """Publish the references for one action, their total wrench, and whether the target wrench
        is out of reach."""
        wrench = self._wrenches.newest()
        action = self._references.act(None if wrench is None else np.array(wrench))
        if action.given_up.any():
            axes = ", ".join(WRENCH_AXES[axis] for axis in np.flatnonzero(action.given_up))
            self._once(
                f"{self.config.reference_topic}: out of reach of the fins in {axes}; for the "
                f"resulting wrench, see {self.config.wrench_topic}"
            )
        for number, (fin, (x, y)) in enumerate(zip(self.fins, action.forces.tolist(), strict=True)):
            self._send_reference(fin, x, y)
            if number in self._references.dead:
                self._send(fin.stop, serialized(BOOL, {"data": True}))
        achieved: list[float] = action.wrench.tolist()
        self._send(
            self._achieved,
            cdr(WRENCH_STAMPED, self._stamp_ns(), achieved, self.config.vehicle_frame_id),
        )
        self._send(self._saturated, serialized(BOOL, {"data": bool(action.given_up.any())}))

    def watch(self, request: StopRequest) -> None:
        """Forward stops and check for silent fins, at every 10 ms tick; raises SafetyStop."""
        self._listen(request)
        if self._wrenches.is_lost and self.config.reference_lost == "stop":
            # A robot without its radio link or operator must not keep moving.
            reason = (
                f"{self.config.reference_topic}: no wrench for "
                f"{self.config.reference_timeout_s:g} s"
            )
            raise SafetyStop(
                f"{reason}; a stop was sent to every fin; start the publisher, then restart the "
                "nodes"
            )
        now = self._clock()
        timeout = self.config.fin_timeout_s
        for number, fin in enumerate(self.fins):
            if number not in self._references.dead and fin.is_silent(now, timeout):
                reason = f"{fin.name} is silent: nothing on {fin.joint_topic} for {timeout:g} s"
                if self.robot.silent_fin == "stop":
                    raise SafetyStop(f"{reason}; a stop was sent to every fin")
                self._declare_dead(number, reason)

    def _await_fins(self, pace: Pace, request: StopRequest) -> None:
        """Wait until every fin publishes and subscribes; fins that do not are treated as silent."""
        self._once.report(
            f"{self.robot.name}: waiting for {', '.join(fin.joint_topic for fin in self.fins)}"
        )
        deadline = self._clock() + self.config.wait_s
        while missing := {n: found for n, fin in enumerate(self.fins) if (found := fin.missing())}:
            if self._clock() > deadline:
                break
            pace.wait()
            self._listen(request)
        if missing and self.robot.silent_fin == "stop":
            told = ", ".join(itertools.chain.from_iterable(missing.values()))
            raise DeviceError(
                f"after {self.config.wait_s:g} s {told}; start `softfin ros2` for each fin with "
                "these topics, in the same domain and network; a stop was sent to every fin"
            )
        for number, found in missing.items():
            self._declare_dead(number, f"{self.fins[number].name} is missing: {', '.join(found)}")

    def _listen(self, request: StopRequest) -> None:
        """Process received messages; raises SafetyStop if a stop was requested."""
        # Also receive wrenches, so that their age counts from their arrival and not from the next
        # action.
        self._wrenches.newest()
        try:
            for fin in self.fins:
                fin.listen()
        except DeviceError as error:
            raise SafetyStop(f"cannot receive messages from the fins: {error}") from None
        reason = self._stop.reason()
        if reason is not None:
            request.ask("emergency_stop", reason)
        if request.trip is not None:
            raise SafetyStop(f"{request.trip.reason}; a stop was sent to every fin")

    def _declare_dead(self, number: int, reason: str) -> None:
        self._references.declare_dead(number)
        if len(self._references.dead) == len(self.fins):
            raise SafetyStop(f"{reason}; no fins are left")
        self._once.report(
            f"{reason}: declared dead until this node is restarted; the other fins continue"
        )

    def _stop_fins(self, pace: Pace) -> None:
        """Send stops to every fin until all are silent, and report fins that are not."""
        deadline = self._clock() + STOPPING_S
        while True:
            for fin in self.fins:
                self._send(fin.stop, serialized(BOOL, {"data": True}))
                self._send_reference(fin, 0.0, 0.0)
            pace.wait()
            now = self._clock()
            going = []
            for fin in self.fins:
                # A node that hears nothing must still send its stops.
                with contextlib.suppress(DeviceError):
                    fin.listen()
                if not fin.is_silent(now, QUIET_S):
                    going.append(fin.name)
            if not going:
                return
            if now > deadline:
                self._once.report(
                    f"{', '.join(going)}: still publishing {STOPPING_S:g} s after the stop; switch "
                    "off the supply of their motors"
                )
                return

    def _send_reference(self, fin: FinTopics, x: float, y: float) -> None:
        # An empty frame means the fin's own frame, whatever its name.
        self._send(
            fin.reference, cdr(WRENCH_STAMPED, self._stamp_ns(), (x, y, 0.0, 0.0, 0.0, 0.0), "")
        )

    def _send(self, publisher: Publisher, data: bytes) -> None:
        try:
            publisher.send(data)
        except DeviceError as error:
            self._once(str(error))

    def _stamp_ns(self) -> int:
        return round(self._clock.wall() * 1e9)

    def _read(self, message: object) -> Wrench:
        check_frame(message, self.config.vehicle_frame_id)
        wrench = read_wrench(message)
        if max(map(abs, wrench)) > WRENCH_LIMIT:
            raise ValueError(f"a component exceeds {WRENCH_LIMIT:g} N or N m")
        return wrench


def check_topics(robot: RobotConfig, config: RobotNodeConfig) -> None:
    """Raise RigError if a fin is unsuitable or two topics would have the same name."""
    topics = [value for name, value in config if name.endswith("_topic")]
    for name in robot.fins:
        if not (name.isascii() and name.isidentifier()):
            raise RigError(
                f"{robot.name}: fin {name!r} cannot be part of a topic name; use letters, "
                "digits and _"
            )
        topics += fin_topics(name, config.fin_prefix).values()
    try:
        check_names(topics)
    except ValueError as error:
        raise RigError(f"{robot.name}: {error}") from None
