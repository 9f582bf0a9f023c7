"""A fin behind ROS 2 topics: any driver that publishes a joint and a wrench and accepts commands,
instead of our devices.

Tested with our own drivers on loopback, not yet with a real driver or a ROS 2 node.
"""

import contextlib
import functools
import importlib.util
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError, one_line
from softfin.core.quantities import Limits
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Sample, Target, Wrench, rotated, rotation
from softfin.rig.ros2.braking import brake
from softfin.rig.ros2.config import FlipperConfig, Ros2PlantConfig, TransportConfig
from softfin.rig.ros2.connection import (
    BOOL,
    Publisher,
    Subscription,
    Transport,
    read_joint,
    read_wrench,
)
from softfin.rig.safety import accept_target
from softfin.storage.bag.messages import (
    JOINT_STATE,
    SECOND_NS,
    WRENCH_STAMPED,
    cdr,
    serialized,
    type_store,
)

COMMAND_RATE_HZ = 20.0
"""Repetition rate of JointState commands [Hz]."""

COMMAND_DEADLINE_S = 0.2
"""Time without commands after which a driver should stop its fin [s]: four commands are missing by
then, and the time exceeds the default limit for late ticks."""

LOCK_S = 0.02
"""Maximum wait of a stop for a command in progress [s]; a command takes at most 5 ms unless it
hangs."""


def open_transport(config: TransportConfig, types: Typestore | None = None) -> Transport:
    """Open the configured transport (auto: rclpy if installed, otherwise DDS); raises RigError if
    the transport is not installed."""
    installed = importlib.util.find_spec("rclpy") is not None
    if config.transport == "rclpy" and not installed:
        raise RigError(
            "rclpy is not installed in this Python environment; source the ROS 2 setup file, or "
            "use transport: dds"
        )
    if config.transport == "rclpy" or (config.transport == "auto" and installed):
        from softfin.rig.ros2.rclpy import RclpyTransport

        return RclpyTransport(config)
    from softfin.rig.ros2.dds import DdsTransport

    return DdsTransport(config, types or type_store())


def encode_flipper(config: FlipperConfig, types: Typestore, angle: float) -> bytes:
    """Return the message that moves the flipper to an angle [rad]; raises RigError if the message
    cannot be built."""
    seconds, rest = divmod(time.time_ns(), SECOND_NS)
    stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}
    try:
        has_header = "header" in dict(types.fielddefs[config.type][1])
        values = config.constants | {config.amplitude: 0.0, config.zero_direction: angle}
        return serialized(config.type, {**(stamp if has_header else {}), **values}, types)
    except Exception as error:
        # Unknown types, missing fields and wrong values raise many kinds of exceptions.
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise RigError(
            f"flipper: {config.type} cannot be built ({reason}); put the .msg text of each type "
            "that ROS 2 does not have into flipper.definitions, and write fields as paths of "
            "names and indices, e.g. flippers.2.amplitude"
        ) from None


def define_types(definitions: Mapping[str, str]) -> Typestore:
    """Return the standard ROS 2 types and the types defined by the text of .msg files; raises
    RigError if a text is invalid."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    kind = ""
    try:
        for kind, text in definitions.items():
            types.register(get_types_from_msg(text, kind))
    except Exception as error:
        # The parser and the registration raise many kinds of exceptions.
        raise RigError(
            f"message {kind}: invalid definition ({one_line(error)}); copy it from its .msg file"
        ) from None
    return types


class SentCommands:
    """Commands as messages, which are repeated while active, and the setpoint that moves towards
    the target."""

    def __init__(
        self, publisher: Publisher, encode: Callable[[Target, float], bytes], period_s: float
    ) -> None:
        """Start without a target; `encode` builds a message from the target and the setpoint
        [rad]."""
        self.publisher = publisher
        self._encode = encode
        self._period = period_s
        self._setpoint = self._since = self._next = 0.0
        self.restart()

    def restart(self) -> None:
        """Make the next setpoint start at the measured angle."""
        self.target: Target | None = None
        """Target of the setpoint; None if the next setpoint starts at the measured angle."""
        self._recent: deque[tuple[float, float]] = deque()

    def send(self, target: Target, angle: float, now: float) -> None:
        """Move to a target from the current setpoint, or from the measured angle if there is no
        setpoint yet."""
        self._setpoint = angle if self.target is None else self._at(self.target, now)
        self.target = target
        self._since = now
        self._next = now
        self.tick(now)

    def tick(self, now: float) -> None:
        """Send the next message if it is due."""
        # Ticks may be slightly early or late.
        if self.target is not None and now >= self._next - 1e-3:
            # Stay in phase with the first message; messages missed in a late tick are skipped.
            self._next += self._period * (max((now - self._next) // self._period, 0) + 1)
            self.publisher.send(self._encode(self.target, self._at(self.target, now)))

    def hold(self, angle: float, velocity: float) -> None:
        """Send one message that holds the fin at an angle [rad]; may be called from any thread."""
        self.publisher.send(self._encode(Target(angle, velocity), angle))

    def following_error(self, angle: float, now: float, delay_s: float) -> float:
        """Return the angle by which the setpoint leads a measured angle [rad].

        The error is 0 if the angle is within the range of the setpoints of the last `delay_s` [s],
        because the driver may lag by this time.
        """
        assert self.target is not None
        self._recent.append((now, self._at(self.target, now)))
        while self._recent[0][0] < now - delay_s:
            self._recent.popleft()
        # Signed distance of the angle from the interval of recent setpoints.
        setpoints = [setpoint for _, setpoint in self._recent]
        return max(min(setpoints) - angle, 0.0) + min(max(setpoints) - angle, 0.0)

    def _at(self, target: Target, now: float) -> float:
        # A ramp at constant velocity from the setpoint at the time of the command.
        reach = target.velocity * (now - self._since)
        return self._setpoint + min(max(target.angle - self._setpoint, -reach), reach)


JointSubscription: TypeAlias = Subscription[tuple[float, float | None]]
"""Subscription to angles [rad] and, unless the driver omits them, velocities [rad/s]."""


class _Topics(NamedTuple):
    """Open topics and their transport."""

    transport: Transport
    joint: JointSubscription
    wrench: Subscription[Wrench]
    commands: SentCommands
    stop: Publisher | None


class Ros2Machine:
    """A fin behind ROS 2 topics that implements the `Machine` protocol.

    The driver determines how a stop works. `stop` commands the fin to hold its last measured angle,
    so that the driver brakes it. With a `stop_topic`, it also sends `true` on that topic. Both
    messages are repeated until the fin is at rest. The motor may stay on. A driver that ignores the
    messages does not stop, which is reported. Keep a switch for the motor supply within reach.
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
        # Re-entrant, because a signal handler may stop the machine while the same thread is sending
        # a command.
        self._lock = clock.lock()
        # The loop reads, and a stop in a different thread checks whether the fin still turns.
        self._reading = clock.lock()
        topic = config.command_topic
        domain = config.connection.domain_id()
        self.device_lock = DeviceLock(f"fin behind {topic}", "ros2-command", domain, topic)
        self._topics: _Topics | None = None
        self._enabled = False
        self._was_enabled = False
        """Whether the fin has been enabled since `open`, which makes softfin responsible for its
        motion."""
        self._stop_failure: str | None = None
        self._joint: tuple[float, float, float] | None = None
        """Time [s], angle [rad] and velocity [rad/s]."""
        self._force: tuple[float, Wrench] | None = None
        self._counted: dict[str, int] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the connection, including a note if the command topic cannot be locked."""
        if self._topics is None:
            return ()
        note = self.device_lock.note
        return (*self._topics.transport.notes, *([] if note is None else [note]))

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning after a stop, which is never confirmed: the motor may still be on, or the fin may
        still turn."""
        return (
            self._stop_failure
            or "softfin cannot confirm that the motor is off; keep a switch for its supply "
            "within reach"
        )

    def open(self) -> None:
        """Wait for the first joint and wrench messages; nothing is sent.

        Raises RigError or DeviceError if a different program may command the fin, or if a topic of
        readings does not have exactly one publisher.
        """
        self.close()
        self._stop_failure = None
        config = self.config
        flipper = self.config.flipper
        sign = self._sign
        turn = rotation(self.config.frame)
        transport = self._opener(config.connection, self._types)

        def subscribe(topic: str, kind: str, read: Callable[[Any], object]) -> Subscription[Any]:
            # This quality matches every publisher, and resent readings would be too late anyway.
            return Subscription(transport, topic, kind, read, quality="best_effort")

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
            self.device_lock.acquire(self.clock)
            # Report errors in the flipper configuration before anything is sent.
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
            self._await_first(joint, wrench)
            # Check before we create our own publisher, which would make a second program stop the
            # fin.
            if problems := self._explain_publishers(transport, joint, wrench):
                raise DeviceError(problems[0])
            kind = flipper.type if flipper else JOINT_STATE
            publisher = transport.publish(config.command_topic, kind, COMMAND_DEADLINE_S)
            commands = SentCommands(
                publisher, encode, 1 / (flipper.rate_hz if flipper else COMMAND_RATE_HZ)
            )
            stop = None if config.stop_topic is None else transport.publish(config.stop_topic, BOOL)
            self._topics = _Topics(transport, joint, wrench, commands, stop)
        except BaseException:
            self.close()
            transport.close()
            raise

    def read(self) -> Sample:
        """Return the latest readings of both topics."""
        topics = self._take()
        assert self._joint is not None
        assert self._force is not None
        complaints = self._explain_publishers(topics.transport, topics.joint, topics.wrench)
        complaints += [
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
                        f"{topic} no longer has a subscriber, so commands are lost; restart the "
                        "driver"
                    )
        return Sample(*self._joint, None, following_error, *self._force, tuple(complaints))

    def enable(self) -> None:
        """Start accepting commands, and hold the current angle."""
        topics = self._take()
        limits = self.limits
        assert self._joint is not None
        angle = self._joint[1]
        if not limits.angle_min - 1e-3 <= angle <= limits.angle_max + 1e-3:
            raise DeviceError(
                f"the fin is at {angle:.3f} rad, outside {limits.angle_min:.3f} to "
                f"{limits.angle_max:.3f} rad; move the fin back with its own driver"
            )
        if problems := self._explain_publishers(topics.transport, topics.joint, topics.wrench):
            raise DeviceError(problems[0])
        if not topics.commands.publisher.readers():
            raise DeviceError(
                f"no subscriber on {self.config.command_topic}, so commands would be lost; "
                "start the driver, and check the topic type"
            )
        with self._lock:
            if self.config.stop_release and topics.stop is not None:
                topics.stop.send(serialized(BOOL, {"data": False}))
            # After a stop, the fin is not at the setpoint of the previous motion.
            topics.commands.restart()
            self._stop_failure = None
            self._enabled = self._was_enabled = True
            self._send(topics.commands.send, Target(angle, limits.velocity_min), angle)

    def command(self, target: Target) -> None:
        """Move to a target, replacing the previous one."""
        accept_target(target, self.limits)
        with self._lock:
            if not self._enabled or self._topics is None or self._joint is None:
                raise DeviceError("the fin is not enabled; enable it before you command it")
            self._send(self._topics.commands.send, target, self._joint[1])

    def stop(self) -> None:
        """Brake until the fin is at rest, for at most 0.5 s; see the class for its limitations."""
        # A command that hangs in the transport must not block the stop by the watchdog.
        alone = self._lock.acquire(timeout=LOCK_S)
        self._enabled = False
        topics = self._topics
        if alone:
            self._lock.release()
        if topics is None:
            return
        # If the loop hung, the latest reading is old, and holding an old angle would move the fin.
        # Therefore, read again, in a thread because the transport may hang. If no thread can be
        # started, stop anyway.
        with contextlib.suppress(RuntimeError):
            self.clock.spawn(self._read_quietly, "ros2 reading before a stop").join(LOCK_S)
        joint = self._joint
        if joint is None:
            return
        # Use the lowest velocity because it limits how fast the fin returns if it has already
        # passed the angle; braking does not depend on the velocity.
        velocity = self.limits.velocity_min or self.limits.velocity_max
        sends = []
        if self._was_enabled:
            # Always send this message, and send it first: the only reader of the stop topic may be
            # a recorder instead of the driver.
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
            # If softfin did not enable the fin, its motion is caused by something else.
            self._stop_failure = None
        elif last and last[0][0] > joint[0]:
            self._stop_failure = "the fin is still turning; switch off its supply"
        else:
            self._stop_failure = (
                f"no new {self.config.joint_topic}, so the fin may still be turning; switch off "
                "its supply"
            )

    def close(self) -> None:
        """Stop and disconnect; nothing is sent if the machine is not enabled."""
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
        self.device_lock.release()

    def counters(self) -> dict[str, int]:
        """Return the counters of both topics, or their final values after `close`."""
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

    def _explain_publishers(
        self, transport: Transport, joint: JointSubscription, wrench: Subscription[Wrench]
    ) -> list[str]:
        """Return one line per publisher fault, ending with the fix. Faults are a topic of readings
        without exactly one publisher, and a different publisher of commands."""
        lines = [joint.explain_publishers(), wrench.explain_publishers()]
        topic = self.config.command_topic
        if others := transport.publishers(topic):
            lines.append(
                f"{topic}: {', '.join(others)} may also command this fin; close that program first"
            )
        return [line for line in lines if line is not None]

    def _await_first(self, joint: JointSubscription, wrench: Subscription[Wrench]) -> None:
        deadline = self.clock() + self.config.wait_s
        while (self._joint is None or self._force is None) and self.clock() < deadline:
            self._process(joint, wrench)
            self.clock.sleep(0.002)
        for awaited, value in ((joint, self._joint), (wrench, self._force)):
            if value is None:
                raise DeviceError(awaited.explain_silence(self.config.wait_s))

    def _take(self) -> _Topics:
        """Process received messages; raises DeviceError if the machine is closed."""
        topics = self._topics
        if topics is None:
            raise DeviceError("the machine is closed; open it first")
        self._process(topics.joint, topics.wrench)
        return topics

    def _process(self, joint: JointSubscription, wrench: Subscription[Wrench]) -> None:
        with self._reading:
            for at, (angle, velocity) in joint.take():
                if velocity is None:
                    # If the driver does not report a velocity, use the difference from the previous
                    # reading.
                    then, before, _ = self._joint or (at, 0.0, 0.0)
                    velocity = (self._sign * angle - before) / (at - then) if at > then else 0.0
                else:
                    velocity *= self._sign
                self._joint = at, self._sign * angle, velocity
            self._force = next(reversed(wrench.take()), self._force)

    def _read_quietly(self) -> None:
        with contextlib.suppress(Exception):
            self._take()

    def _send(self, send: Callable[..., None], *what: Target | float) -> None:
        """Send a motion command; if a signal handler stopped the machine in the meantime, stop
        again."""
        send(*what, self.clock())
        if not self._enabled:
            self.stop()
