"""A fin made of topics: any driver that publishes a joint and a wrench, and takes commands, in place of our devices.

Tried with drivers of our own making on loopback; it has met neither a real driver nor a node of ROS 2.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from softfin.core.errors import CommandError, DeviceError
from softfin.core.quantities import Limits
from softfin.rig.frame import rotated, rotation
from softfin.rig.machine import Sample, Target, Wrench
from softfin.rig.ros2.config import Ros2PlantConfig, TransportConfig
from softfin.rig.ros2.connection import Stamped, Subscription, open_transport
from softfin.rig.ros2.flipper import FlipperCommands
from softfin.rig.ros2.messages import BOOL, JOINT, WRENCH, Messages, joint_of, wrench_of
from softfin.rig.ros2.transport import Publisher, Transport

ROUNDING = 1e-3
"""How far beyond a limit a command may be by rounding [rad, rad/s]."""

LOCK_S = 0.02
"""Longest that a stop waits for a command that is going out [s]; over DDS that takes 5 ms at most."""


class JointCommands:
    """Commands as sensor_msgs/JointState, one message for each; the driver holds it. FlipperCommands sends others."""

    def __init__(self, publisher: Publisher, messages: Messages, joint: str, velocity: float) -> None:
        """`velocity` to where the fin holds [rad/s]."""
        self.publisher, self._messages, self._joint, self._velocity = publisher, messages, joint, velocity

    def send(self, target: Target, angle: float, now: float) -> None:
        """Send the target, whatever the measured angle is."""
        message = self._messages.joint(time.time_ns(), "", self._joint, target.angle, target.velocity)
        self.publisher.send(self._messages.encode(message))

    def tick(self, now: float) -> None:
        """Send nothing; called at every tick while the fin is enabled, for drives that need messages more often."""

    def hold(self, angle: float) -> None:
        """Go no further: the last message until the next `send`."""
        self.send(Target(angle, self._velocity), angle, 0.0)


class _Topics(NamedTuple):
    """Everything that is open."""

    transport: Transport
    messages: Messages
    joint: Subscription[tuple[float, float | None]]
    wrench: Subscription[Wrench]
    commands: JointCommands | FlipperCommands
    stop: Publisher | None

    def send_stop(self, stop: bool) -> None:
        """Ask the driver to stop, or take that back, where it has a topic for it."""
        if self.stop is not None:
            self.stop.send(self.messages.encode(self.messages.make(BOOL, stop)))


class Ros2Machine:
    """Meets the Machine contract.

    What a stop does lies with the driver. With a `stop_topic` that somebody reads, `true` goes there, and what follows
    is the driver's doing. Else the last command holds the angle that was last measured: the fin brakes as its driver
    brakes, the motor stays on, and a driver that does not listen goes on. Keep a switch of the motor's supply at hand.
    """

    name = "ros2"

    def __init__(
        self, config: Ros2PlantConfig, clock: Callable[[], float] = time.monotonic,
        opener: Callable[[TransportConfig, Messages], Transport] = open_transport,
    ) -> None:  # fmt: skip
        self.config, self._clock, self._opener = config, clock, opener
        self._sign = -1.0 if config.negate_angle else 1.0
        # A signal's handler may stop the machine while this very thread is in the middle of a command.
        self._lock = threading.RLock()
        self._topics: _Topics | None = None
        self._enabled = False
        self._angle: Stamped[tuple[float, float]] | None = None
        self._force: Stamped[Wrench] | None = None
        self._counted: dict[str, int] = {}

    @property
    def limits(self) -> Limits:
        """The configured limits."""
        return self.config.limits

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the connection."""
        return () if self._topics is None else self._topics.transport.notes

    @property
    def stop_unconfirmed(self) -> str | None:
        """Whatever was sent: whether the motor is off lies with its driver."""
        return "whether the motor is off lies with its driver; keep a switch of its supply at hand"

    def open(self) -> None:
        """Wait until joint and wrench publish; nothing is sent."""
        self.close()
        config = self.config
        messages = Messages(config.flipper.definitions if config.flipper else None)
        transport = self._opener(config.connection, messages)
        try:
            turn, best_effort = rotation(config.frame), config.best_effort
            joint: Subscription[tuple[float, float | None]] = Subscription(
                transport, messages, config.joint_topic, JOINT,
                lambda message: joint_of(message, config.joint_name), best_effort=best_effort,
            )  # fmt: skip
            wrench = Subscription(
                transport, messages, config.wrench_topic, WRENCH,
                lambda message: rotated(wrench_of(message), turn), best_effort=best_effort,
            )  # fmt: skip
            commands: JointCommands | FlipperCommands
            if config.flipper is not None:
                commands = FlipperCommands(transport, messages, config.command_topic, config.flipper)
            else:
                publisher = transport.publish(config.command_topic, JOINT)
                commands = JointCommands(publisher, messages, config.joint_name, self.limits.velocity_max)
            stop = None if config.stop_topic is None else transport.publish(config.stop_topic, BOOL)
            self._topics = _Topics(transport, messages, joint, wrench, commands, stop)
            self._await_first(self._topics)
        except BaseException:
            self.close()
            transport.close()
            raise

    def read(self) -> Sample:
        """The newest of both topics."""
        topics = self._opened()
        self._take(topics)
        if self._angle is None or self._force is None:
            raise DeviceError("nothing has been read yet; open the machine first")
        with self._lock:
            if self._enabled:
                self._send(lambda commands: commands.tick(self._clock()))
        angle, velocity = self._angle.value
        refusals = (topics.joint.refusal, topics.wrench.refusal)
        complaints = tuple(refusal for refusal in refusals if refusal is not None)
        return Sample(self._angle.time, angle, velocity, None, None, self._force.time, self._force.value, complaints)

    def enable(self) -> None:
        """Take commands, and hold where it is."""
        topics, limits = self._opened(), self.limits
        self._take(topics)
        angle = self._measured()
        if not limits.angle_min - ROUNDING <= angle <= limits.angle_max + ROUNDING:
            raise DeviceError(f"the fin is at {angle:.3f} rad, beyond {limits.angle_min:.3f} to "
                              f"{limits.angle_max:.3f} rad; bring it back by its own driver")  # fmt: skip
        if not topics.commands.publisher.readers():
            raise DeviceError(f"nobody reads {self.config.command_topic}: commands would go nowhere; start the driver, "
                              "and check the topic's type")  # fmt: skip
        with self._lock:
            if self.config.stop_release:
                topics.send_stop(False)
            self._enabled = True
            hold = Target(self._sign * angle, limits.velocity_min)
            self._send(lambda commands: commands.send(hold, hold.angle, self._clock()))

    def command(self, target: Target) -> None:
        """Go there from now on."""
        limits = self.limits
        for name, value, low, high in (
            ("angle", target.angle, limits.angle_min, limits.angle_max),
            ("velocity", target.velocity, limits.velocity_min, limits.velocity_max),
        ):
            if not low - ROUNDING <= value <= high + ROUNDING:
                raise CommandError(f"{name} {value:g}: this fin takes {low:g} to {high:g}; train within them")
        with self._lock:
            if not self._enabled:
                raise DeviceError("the fin is not enabled; enable it before it is commanded")
            aim, measured = Target(self._sign * target.angle, target.velocity), self._sign * self._measured()
            self._send(lambda commands: commands.send(aim, measured, self._clock()))

    def stop(self) -> None:
        """See the class for what it can do and cannot."""
        # A command that hangs in its transport must not keep the watchdog from its stop.
        alone = self._lock.acquire(timeout=LOCK_S)
        try:
            was_enabled, self._enabled = self._enabled, False
            self._brake(was_enabled)
        finally:
            if alone:
                self._lock.release()

    def close(self) -> None:
        """Stop and leave; a machine that was not enabled sends nothing."""
        with self._lock:
            if self._enabled:
                self.stop()
            self._counted = self.counters()
            topics, self._topics = self._topics, None
            self._angle = self._force = None
        if topics is not None:
            topics.transport.close()

    def counters(self) -> dict[str, int]:
        """Counts of both topics; after `close` the last ones."""
        if self._topics is None:
            return self._counted
        return {
            f"{name}_{count}": getattr(subscription, count)
            for name, subscription in (("joint", self._topics.joint), ("wrench", self._topics.wrench))
            for count in ("received", "refused", "not_newer")
        }

    def _await_first(self, topics: _Topics) -> None:
        deadline = time.monotonic() + self.config.wait_s
        while self._angle is None or self._force is None:
            self._take(topics)
            if time.monotonic() > deadline:
                break
            time.sleep(0.002)
        for subscription, value in ((topics.joint, self._angle), (topics.wrench, self._force)):
            if value is None:
                there = list(topics.transport.topics().items())[:20]
                listed = ", ".join(f"{topic} ({kind})" for topic, kind in there) or "nothing"
                raise DeviceError(
                    subscription.refusal
                    or f"{subscription.topic}: no {subscription.kind} in {self.config.wait_s:g} s; there is {listed}; "
                    "start its driver, correct the topic, or the domain (ROS_DOMAIN_ID) and the network"
                )

    def _opened(self) -> _Topics:
        if self._topics is None:
            raise DeviceError("the machine is closed; open it first")
        return self._topics

    def _take(self, topics: _Topics) -> None:
        for joint in topics.joint.take():
            angle, velocity, before = self._sign * joint.value[0], joint.value[1], self._angle
            if velocity is not None:
                velocity *= self._sign
            elif before is None or joint.time <= before.time:
                velocity = 0.0
            else:
                # A driver that reports no velocity: the difference from the reading before.
                velocity = (angle - before.value[0]) / (joint.time - before.time)
            self._angle = Stamped(joint.time, joint.received, (angle, velocity))
        self._force = next(reversed(topics.wrench.take()), self._force)

    def _measured(self) -> float:
        if self._angle is None:
            raise DeviceError("the fin's angle is not known; open the machine first")
        return self._angle.value[0]

    def _send(self, message: Callable[[JointCommands | FlipperCommands], None]) -> None:
        """A message that moves; a stop in between, by a signal, has the last word."""
        if self._topics is not None:
            message(self._topics.commands)
        if not self._enabled:
            self._brake(was_enabled=True)

    def _brake(self, was_enabled: bool) -> None:
        topics = self._topics
        if topics is None:
            return
        with contextlib.suppress(Exception):
            if topics.stop is not None:
                topics.send_stop(True)
                if topics.stop.readers():
                    return
        with contextlib.suppress(Exception):
            if was_enabled and self._angle is not None:
                topics.commands.hold(self._sign * self._angle.value[0])
