"""A fin made of topics: any driver that publishes a joint and a wrench, and takes commands, in
place of our devices.

Tried with drivers of our own making on loopback; it has met neither a real driver nor a node of ROS
2.
"""

import contextlib
import functools
import importlib.util
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.clock import REAL, Clock
from softfin.core.errors import CommandError, DeviceError, RigError, one_line
from softfin.core.quantities import Limits
from softfin.rig.machine import Sample, Target, Wrench, rotated, rotation
from softfin.rig.ros2.braking import brake
from softfin.rig.ros2.config import FlipperConfig, Ros2PlantConfig, TransportConfig
from softfin.rig.ros2.connection import (
    BOOL,
    Publisher,
    Quality,
    Subscription,
    Transport,
    read_joint,
    read_wrench,
)
from softfin.rig.safety import check_target
from softfin.storage.bag.messages import (
    JOINT_STATE,
    SECOND_NS,
    WRENCH_STAMPED,
    cdr,
    serialized,
    type_store,
)

COMMAND_RATE_HZ = 20.0
"""Rate at which a JointState command is repeated [Hz]."""

COMMAND_DEADLINE_S = 0.2
"""Silence on the command topic after which a driver should stop its fin [s]: four commands are
missing by then, and it is longer than the lateness of a tick that safety tolerates by default."""

LOCK_S = 0.02
"""Longest wait of a stop for a command in progress [s]; it takes 5 ms at most, unless it hangs."""


def open_transport(config: TransportConfig, types: Typestore | None = None) -> Transport:
    """rclpy where it is installed, else DDS, or as configured; raises RigError where that is not
    installed."""
    installed = importlib.util.find_spec("rclpy") is not None
    if config.transport == "rclpy" and not installed:
        raise RigError(
            "rclpy is not installed in this Python; source ROS 2's setup file, or use transport: "
            "dds"
        )
    if config.transport == "rclpy" or (config.transport == "auto" and installed):
        from softfin.rig.ros2.rclpy import RclpyTransport

        return RclpyTransport(config)
    from softfin.rig.ros2.dds import DdsTransport

    return DdsTransport(config, types or type_store())


def encode_flipper(config: FlipperConfig, types: Typestore, angle: float) -> bytes:
    """The message by which the flipper stands at an angle [rad]; else raises RigError."""
    seconds, rest = divmod(time.time_ns(), SECOND_NS)
    stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}
    try:
        has_header = "header" in dict(types.fielddefs[config.type][1])
        values = config.constants | {config.amplitude: 0.0, config.zero_direction: angle}
        return serialized(config.type, {**(stamp if has_header else {}), **values}, types)
    except Exception as error:
        # Unknown types, fields that are not there and values that do not fit fail in ways of their
        # own.
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise RigError(
            f"flipper: {config.type} cannot be built ({reason}); put the .msg text of each type "
            "that ROS 2 lacks into flipper.definitions, and write fields as paths of names and "
            "indices, such as flippers.2.amplitude"
        ) from None


def define_types(definitions: Mapping[str, str]) -> Typestore:
    """ROS 2's own types, and others by the text of their .msg files; raises RigError where that is
    not such a text."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    kind = ""
    try:
        for kind, text in definitions.items():
            types.register(get_types_from_msg(text, kind))
    except Exception as error:
        # The parser and the registration fail in ways of their own.
        raise RigError(
            f"message {kind}: its definition cannot be used ({one_line(error)}); copy it from its "
            ".msg file"
        ) from None
    return types


class SentCommands:
    """Commands as messages, repeated while they are in force, and the set-point that goes to the
    target meanwhile."""

    def __init__(
        self, publisher: Publisher, encode: Callable[[Target, float], bytes], period_s: float
    ) -> None:
        """`encode` makes a message of the target and the set-point [rad]."""
        self.publisher = publisher
        self._encode = encode
        self._period = period_s
        self._setpoint = self._since = self._next = 0.0
        self.restart()

    def restart(self) -> None:
        """Begin the next set-point at the measured angle."""
        self.target: Target | None = None
        """Target of the set-point; None where that begins at the measured angle."""
        self._recent: deque[tuple[float, float]] = deque()

    def send(self, target: Target, angle: float, now: float) -> None:
        """Move on from where the set-point is; from the measured angle where there is none yet."""
        self._setpoint = angle if self.target is None else self._at(self.target, now)
        self.target = target
        self._since = now
        self._next = now
        self.tick(now)

    def tick(self, now: float) -> None:
        """Send the next message, where it is due."""
        # Ticks come a little early and late.
        if self.target is not None and now >= self._next - 1e-3:
            # In step with the first one; what a late tick has missed is not made up for.
            self._next += self._period * (max((now - self._next) // self._period, 0) + 1)
            self.publisher.send(self._encode(self.target, self._at(self.target, now)))

    def hold(self, angle: float, velocity: float) -> None:
        """Send one message by which it stays at an angle [rad]; from any thread."""
        self.publisher.send(self._encode(Target(angle, velocity), angle))

    def following_error(self, angle: float, now: float, delay_s: float) -> float:
        """Return by how much the set-point leads a measured angle [rad].

        A fin that is where any set-point of the last `delay_s` was has no error: the driver may be
        late by so much.
        """
        assert self.target is not None
        self._recent.append((now, self._at(self.target, now)))
        while self._recent[0][0] < now - delay_s:
            self._recent.popleft()
        setpoints = [setpoint for _, setpoint in self._recent]
        return max(min(setpoints) - angle, 0.0) + min(max(setpoints) - angle, 0.0)

    def _at(self, target: Target, now: float) -> float:
        reach = target.velocity * (now - self._since)
        return self._setpoint + min(max(target.angle - self._setpoint, -reach), reach)


class _Topics(NamedTuple):
    """Everything that is open."""

    transport: Transport
    joint: Subscription[tuple[float, float | None]]
    wrench: Subscription[Wrench]
    commands: SentCommands
    stop: Publisher | None


class Ros2Machine:
    """Meets the Machine contract.

    The driver determines how a stop works. `stop` commands the fin to hold its last measured angle,
    so that the driver brakes it. With a `stop_topic`, it also sends `true` there. It repeats both
    until the fin is at rest. The motor may stay on. A driver that ignores the messages does not
    stop, which is reported. Keep a switch for the motor's supply at hand.
    """

    name = "ros2"

    def __init__(
        self,
        config: Ros2PlantConfig,
        clock: Clock = REAL,
        opener: Callable[[TransportConfig, Typestore], Transport] = open_transport,
    ) -> None:
        self.config = config
        self.clock = clock
        self._opener = opener
        self.limits: Limits = config.limits
        self._types = define_types(config.flipper.definitions if config.flipper else {})
        self._sign = -1.0 if config.negate_angle else 1.0
        # A signal's handler may stop the machine while this very thread is in the middle of a
        # command.
        self._lock = clock.lock()
        # The loop reads, and a stop in another thread looks whether the fin still turns.
        self._reading = clock.lock()
        self._topics: _Topics | None = None
        self._enabled = False
        self._was_enabled = False
        """Whether it was since it was opened: then its motion is softfin's."""
        self._stop_failure: str | None = None
        self._joint: tuple[float, float, float] | None = None
        """Time [s], angle [rad] and velocity [rad/s]."""
        self._force: tuple[float, Wrench] | None = None
        self._counted: dict[str, int] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the connection."""
        return () if self._topics is None else self._topics.transport.notes

    @property
    def stop_unconfirmed(self) -> str | None:
        """Doubt that is left after a stop: whether the motor is off, always; and whether the fin
        still turns."""
        return (
            self._stop_failure
            or "softfin cannot confirm that the motor is off; keep a switch for its supply at hand"
        )

    def open(self) -> None:
        """Wait until joint and wrench publish; nothing is sent."""
        self.close()
        self._stop_failure = None
        config = self.config
        flipper = self.config.flipper
        sign = self._sign
        turn = rotation(self.config.frame)
        transport = self._opener(config.connection, self._types)

        def subscribe(topic: str, kind: str, read: Callable[[Any], object]) -> Subscription[Any]:
            quality: Quality = "best_effort" if config.best_effort else "reliable"
            return Subscription(transport, topic, kind, read, quality=quality)

        def encode(target: Target, setpoint: float) -> bytes:
            if flipper is not None:
                return encode_flipper(flipper, self._types, sign * setpoint)
            return cdr(
                JOINT_STATE,
                time.time_ns(),
                (sign * target.angle, target.velocity),
                "",
                config.joint_name,
            )

        try:
            # What a flipper's configuration lacks is told before anything is sent.
            encode(Target(0.0, 0.0), 0.0)
            joint = subscribe(
                config.joint_topic,
                JOINT_STATE,
                lambda message: read_joint(message, config.joint_name),
            )
            wrench = subscribe(
                config.wrench_topic,
                WRENCH_STAMPED,
                lambda message: rotated(read_wrench(message), turn),
            )
            kind = flipper.type if flipper else JOINT_STATE
            publisher = transport.publish(config.command_topic, kind, COMMAND_DEADLINE_S)
            commands = SentCommands(
                publisher, encode, 1 / (flipper.rate_hz if flipper else COMMAND_RATE_HZ)
            )
            stop = None if config.stop_topic is None else transport.publish(config.stop_topic, BOOL)
            self._topics = _Topics(transport, joint, wrench, commands, stop)
            self._await_first(self._topics)
        except BaseException:
            self.close()
            transport.close()
            raise

    def read(self) -> Sample:
        """The newest of both topics."""
        topics = self._take()
        assert self._joint is not None
        assert self._force is not None
        complaints = [
            refusal
            for refusal in (topics.joint.refusal, topics.wrench.refusal)
            if refusal is not None
        ]
        following_error = None
        with self._lock:
            if self._enabled:
                self._send(topics.commands.tick)
            if self._enabled:
                angle = self._joint[1]
                delay_s = self.config.driver_delay_s
                following_error = topics.commands.following_error(angle, self.clock(), delay_s)
                if not topics.commands.publisher.readers():
                    topic = self.config.command_topic
                    complaints.append(
                        f"no subscriber on {topic} any more, so commands are lost; start the "
                        "driver again"
                    )
        return Sample(*self._joint, None, following_error, *self._force, tuple(complaints))

    def enable(self) -> None:
        """Take commands, and hold where it is."""
        topics = self._take()
        limits = self.limits
        assert self._joint is not None
        angle = self._joint[1]
        if not limits.angle_min - 1e-3 <= angle <= limits.angle_max + 1e-3:
            raise DeviceError(
                f"the fin is at {angle:.3f} rad, outside {limits.angle_min:.3f} to "
                f"{limits.angle_max:.3f} rad; move it back with its own driver"
            )
        if not topics.commands.publisher.readers():
            raise DeviceError(
                f"no subscriber on {self.config.command_topic}, so commands would be lost; "
                "start the driver, and check the topic's type"
            )
        with self._lock:
            if self.config.stop_release and topics.stop is not None:
                topics.stop.send(serialized(BOOL, {"data": False}))
            # Where a stop ended the last motion, the fin is not at that motion's set-point.
            topics.commands.restart()
            self._stop_failure = None
            self._enabled = self._was_enabled = True
            self._send(topics.commands.send, Target(angle, limits.velocity_min), angle)

    def command(self, target: Target) -> None:
        """Go there from now on."""
        trip = check_target(target, self.limits)
        if trip is not None:
            raise CommandError(trip.reason)
        with self._lock:
            if not self._enabled or self._topics is None or self._joint is None:
                raise DeviceError("the fin is not enabled; enable it before you command it")
            self._send(self._topics.commands.send, target, self._joint[1])

    def stop(self) -> None:
        """Brake until the fin is at rest, 0.5 s at most; see the class for what it can do and
        cannot."""
        # A command that hangs in its transport must not keep the watchdog from its stop.
        alone = self._lock.acquire(timeout=LOCK_S)
        self._enabled = False
        topics = self._topics
        if alone:
            self._lock.release()
        if topics is None:
            return
        # A loop that hung has not read for a while, and to hold an old angle would be a motion. In
        # a thread, since the transport may be what hangs; a computer that cannot start one stops
        # all the same.
        with contextlib.suppress(RuntimeError):
            self.clock.spawn(self._read_quietly, "ros2 reading before a stop").join(LOCK_S)
        joint = self._joint
        if joint is None:
            return
        # How fast the fin brakes does not depend on this; how fast it would go back to an angle
        # that it has left does.
        velocity = self.limits.velocity_min or self.limits.velocity_max
        sends = []
        if self._was_enabled:
            # First, and whoever reads the stop topic: that may be a recorder, while the driver does
            # not.
            sends.append(functools.partial(topics.commands.hold, joint[1], velocity))
        if topics.stop is not None:
            sends.append(functools.partial(topics.stop.send, serialized(BOOL, {"data": True})))
        if not sends:
            return
        last: list[tuple[float, float]] = []

        def look() -> tuple[float, float]:
            self._take()
            assert self._joint is not None
            last[:] = [self._joint[:2]]
            return last[0]

        if brake(self.clock, sends, look) or not self._was_enabled:
            # A fin that softfin has not moved is turned by somebody else.
            self._stop_failure = None
        elif last and last[0][0] > joint[0]:
            self._stop_failure = "the fin still turns; switch off its supply"
        else:
            self._stop_failure = (
                f"no new {self.config.joint_topic}, so the fin may still turn; "
                "switch off its supply"
            )

    def close(self) -> None:
        """Stop and leave; a machine that was not enabled sends nothing."""
        with self._lock:
            if self._enabled:
                self.stop()
            self._counted = self.counters()
            topics = self._topics
            self._topics = None
            self._joint = self._force = None
            self._was_enabled = False
        if topics is not None:
            topics.transport.close()

    def counters(self) -> dict[str, int]:
        """Counts of both topics; after `close` the last ones."""
        if self._topics is None:
            return self._counted
        return {
            f"{name}_{count}": getattr(subscription, count)
            for name, subscription in (
                ("joint", self._topics.joint),
                ("wrench", self._topics.wrench),
            )
            for count in ("received", "refused", "not_newer")
        }

    def _await_first(self, topics: _Topics) -> None:
        deadline = self.clock() + self.config.wait_s
        while (self._joint is None or self._force is None) and self.clock() < deadline:
            self._take()
            self.clock.sleep(0.002)
        for awaited, value in ((topics.joint, self._joint), (topics.wrench, self._force)):
            if value is None:
                there = [f"{topic} ({kind})" for topic, kind in topics.transport.topics().items()]
                raise DeviceError(
                    awaited.refusal
                    or f"{awaited.topic}: no {awaited.kind} in {self.config.wait_s:g} s; found "
                    f"{', '.join(there[:20]) or 'nothing'}; start its driver, or correct the "
                    "topic, the domain (ROS_DOMAIN_ID) or the network"
                )

    def _take(self) -> _Topics:
        """Take what has come; raises DeviceError where the machine is closed."""
        topics = self._topics
        if topics is None:
            raise DeviceError("the machine is closed; open it first")
        with self._reading:
            for at, (angle, velocity) in topics.joint.take():
                if velocity is None:
                    # A driver that reports no velocity: the difference from the reading before.
                    then, before, _ = self._joint or (at, 0.0, 0.0)
                    velocity = (self._sign * angle - before) / (at - then) if at > then else 0.0
                else:
                    velocity *= self._sign
                self._joint = at, self._sign * angle, velocity
            self._force = next(reversed(topics.wrench.take()), self._force)
        return topics

    def _read_quietly(self) -> None:
        with contextlib.suppress(Exception):
            self._take()

    def _send(self, send: Callable[..., None], *what: Target | float) -> None:
        """Send a message that moves; a stop in between, by a signal, has the last word."""
        send(*what, self.clock())
        if not self._enabled:
            self.stop()
