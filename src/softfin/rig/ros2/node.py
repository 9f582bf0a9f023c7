"""softfin as a ROS 2 node: every sample and command goes out as messages; references and the emergency stop come in.

Called by the thread of the loop; nothing here waits, and nothing here moves the fin.
"""

import contextlib
import math
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import DeviceError, RigError, SoftfinError
from softfin.rig.loop import Force, References
from softfin.rig.machine import Sample, Target
from softfin.rig.references import ResolveReference
from softfin.rig.ros2.intake import Intake
from softfin.rig.ros2.messages import BOOL, JOINT, VECTOR, WRENCH, Messages, TopicName, reference_of
from softfin.rig.ros2.plant import Ros2PlantConfig
from softfin.rig.ros2.transport import Transport, TransportConfig
from softfin.rig.session import Observer
from softfin.rig.stop import StopRequest

NOTES = 20
"""Different lines that are said at most; all are counted."""

KINDS = {"wrench": WRENCH, "vector3": VECTOR}


class NodeConfig(Configuration):
    """Topics and frames of the node; the names are those that `softfin import-logs` looks for in a bag."""

    joint_topic: TopicName = "/fin/joint_states"
    """sensor_msgs/JointState of every sample: angle [rad] and velocity [rad/s]."""
    wrench_topic: TopicName = "/fin/wrench"
    """geometry_msgs/WrenchStamped of every sample: force [N] and torque [N m] of the fin on its mount."""
    command_topic: TopicName = "/fin/command"
    """sensor_msgs/JointState of every new command: angle and profile velocity."""
    reference_topic: TopicName = "/fin/reference"
    """The force that is asked for, x and y [N]."""
    reference_type: Literal["wrench", "vector3"] = "wrench"
    """Its type: geometry_msgs/WrenchStamped or geometry_msgs/Vector3Stamped."""
    stop_topic: TopicName = "/fin/stop"
    """std_msgs/Bool: true stops the fin; false does not take that back."""
    joint_name: str = "fin"
    """Of the joint in the messages."""
    frame: str = "fin_mount"
    """Of the forces: +x is thrust that pushes the robot forward."""
    reference_timeout_s: PositiveFloat | None = 1.0
    """A reference older than this does not count any more [s]; None obeys the newest for ever."""
    reference_limit_n: PositiveFloat = Field(default=20.0)
    """A reference beyond this on either axis is refused [N]: twice what a fin like the paper's can make."""

    connection: TransportConfig = Field(default_factory=TransportConfig)
    """How to reach other nodes."""

    @model_validator(mode="after")
    def _apart(self) -> "NodeConfig":
        names = [getattr(self, name) for name in type(self).model_fields if name.endswith("_topic")]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} is the name of two topics; give each its own")
        return self


def check_apart(node: NodeConfig, plant: Ros2PlantConfig) -> None:
    """Raise RigError where the node would speak on a topic of the fin's own, or take one for a reference."""
    theirs = {getattr(plant, name) for name in ("joint_topic", "wrench_topic", "command_topic", "stop_topic")}
    for name in ("joint_topic", "wrench_topic", "command_topic", "reference_topic"):
        topic = getattr(node, name)
        if topic in theirs:
            raise RigError(f"{name} = {topic}: is a topic of the fin's own; give the node another: --set {name}=/NAME")


class Reference(NamedTuple):
    """A force that somebody asks for."""

    x: float
    """[N]"""
    y: float
    """[N]"""
    received: float
    """When it came, of `time.monotonic` [s]."""


class RosBridge:
    """Between the loop and other nodes. A message that cannot be used is counted, never obeyed."""

    def __init__(
        self, transport: Transport, topics: NodeConfig | None = None, clock: Callable[[], float] = time.monotonic,
        admit: ResolveReference = lambda force: (force, None),
    ) -> None:  # fmt: skip
        self.config, self._clock, self._transport = topics or NodeConfig(), clock, transport
        self._admit, self._admitted = admit, ((math.nan, math.nan), (math.nan, math.nan))
        config, self._messages = self.config, Messages()
        self._joint = transport.publish(config.joint_topic, JOINT)
        self._wrench = transport.publish(config.wrench_topic, WRENCH)
        self._command = transport.publish(config.command_topic, JOINT)
        self._references: Intake[tuple[float, float]] = Intake(
            transport, self._messages, config.reference_topic, KINDS[config.reference_type], self._reference_of,
            stamped=False,
        )  # fmt: skip
        self._stops: Intake[bool] = Intake(
            transport, self._messages, config.stop_topic, BOOL, lambda message: bool(message.data), stamped=False
        )
        self._newest: Reference | None = None
        self._said: Target | None = None
        self._stop: str | None = None
        self._notes: list[str] = []
        self._told_of: set[str] = set()
        self.unsent = 0

    def publish(self, sample: Sample, target: Target | None) -> None:
        """One sample, and the command where it is another one than before; what cannot go out is counted."""
        config, messages = self.config, self._messages
        # Both clocks at the same moment: this computer's date may be set at any time.
        ahead = time.time_ns() - round(time.monotonic() * 1e9)
        stamp, force_stamp = (round(at * 1e9) + ahead for at in (sample.time, sample.force_time))
        try:
            joint = messages.joint(stamp, config.frame, config.joint_name, sample.angle, sample.velocity)
            self._joint.send(messages.encode(joint))
            self._wrench.send(messages.encode(messages.wrench(force_stamp, config.frame, sample.wrench)))
            if target is not None and target != self._said:
                command = messages.joint(stamp, config.frame, config.joint_name, target.angle, target.velocity)
                self._command.send(messages.encode(command))
                self._said = target
        except DeviceError as error:
            self.unsent += 1
            self._note(str(error))

    def reference(self) -> Reference | None:
        """The newest that counts; None where none has come, or the newest is too old."""
        try:
            for told in self._references.take():
                self._newest = Reference(*told.value, told.received)
        except DeviceError as error:
            self._note(str(error))
        if self._references.refusal is not None:
            self._note(self._references.refusal)
        newest, timeout = self._newest, self.config.reference_timeout_s
        if newest is None:
            return None
        if timeout is not None and self._clock() - newest.received > timeout:
            self._newest = None
            topic = self.config.reference_topic
            self._notes.append(f"{topic}: no reference for {timeout:g} s: the last one does not count any more")
            return None
        return newest

    def stop_asked(self) -> str | None:
        """Why to stop, once and for all; None where nobody has asked for it. What cannot be read stops too."""
        if self._stop is not None:
            return self._stop
        topic = self.config.stop_topic
        try:
            asked = any(told.value for told in self._stops.take())
        except DeviceError as error:
            self._stop = f"emergency stop cannot be heard: {error}"
            return self._stop
        if asked:
            self._stop = f"emergency stop on {topic}"
        elif self._stops.refusal is not None:
            self._stop = f"emergency stop: {self._stops.refusal}"
        return self._stop

    def references(self, otherwise: Force) -> References:
        """For the loop: the newest that counts, else the force that was said beforehand."""

        def newest(_: float) -> Force:
            reference = self.reference()
            return otherwise if reference is None else (reference.x, reference.y)

        return newest

    def observer(self, request: StopRequest) -> Observer:
        """For the session: publishes each sample, and hands on who asks for a stop."""

        def observe(sample: Sample, target: Target | None) -> None:
            reason = self.stop_asked()
            if reason is not None:
                request.ask("emergency_stop", reason)
            # Heard here too, so that its age counts from when it came, not from the next action.
            self.reference()
            self.publish(sample, target)

        return observe

    def notes(self) -> list[str]:
        """What a person should hear, each once, since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def counters(self) -> dict[str, int]:
        """References and stops that came and were refused, samples that did not go out."""
        return {
            "references": self._references.received - self._references.refused,
            "references_refused": self._references.refused,
            "stops_refused": self._stops.refused,
            "unsent": self.unsent,
        }

    def close(self) -> None:
        """Leave; any number of times, never raises."""
        with contextlib.suppress(Exception):
            self._transport.close()

    def _reference_of(self, message: object) -> tuple[float, float]:
        force, limit = reference_of(message, self.config.frame), self.config.reference_limit_n
        for axis, value in zip("xy", force, strict=True):
            if not math.fabs(value) <= limit:
                raise ValueError(f"its {axis} is {value:g} N; reference_limit_n is {limit:g} N")
        if force != self._admitted[0]:
            try:
                held, warning = self._admit(force)
            except SoftfinError as error:
                raise ValueError(str(error)) from None
            self._admitted = force, held
            if warning is not None:
                self._note(warning)
        return self._admitted[1]

    def _note(self, line: str) -> None:
        if len(self._told_of) < NOTES and line not in self._told_of:
            self._told_of.add(line)
            self._notes.append(line)
