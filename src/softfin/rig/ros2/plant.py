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
from softfin.rig.machine import Sample, Target, Wrench, rotated, rotation
from softfin.rig.ros2.config import Ros2PlantConfig, TransportConfig
from softfin.rig.ros2.connection import Stamped, Subscription, open_transport
from softfin.rig.ros2.flipper import FlipperCommands
from softfin.rig.ros2.messages import BOOL, JOINT, WRENCH, Messages, joint_of, wrench_of
from softfin.rig.ros2.transport import Publisher, Transport
from softfin.rig.safety import check_target

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
    joint: Subscription[tuple[float, float | None]]
    wrench: Subscription[Wrench]
    commands: JointCommands | FlipperCommands
    stop: Publisher | None


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
        self.limits: Limits = config.limits
        self._messages = Messages(config.flipper.definitions if config.flipper else None)
        self._sign = -1.0 if config.negate_angle else 1.0
        # A signal's handler may stop the machine while this very thread is in the middle of a command.
        self._lock = threading.RLock()
        self._topics: _Topics | None = None
        self._enabled = False
        self._angle: Stamped[tuple[float, float]] | None = None
        self._force: Stamped[Wrench] | None = None
        self._counted: dict[str, int] = {}

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
        transport = self._opener(self.config.connection, self._messages)
        try:
            self._topics = self._subscribe(transport)
            self._await_first(self._topics)
        except BaseException:
            self.close()
            transport.close()
            raise

    def _subscribe(self, transport: Transport) -> _Topics:
        config, messages = self.config, self._messages
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
        return _Topics(transport, joint, wrench, commands, stop)

    def read(self) -> Sample:
        """The newest of both topics."""
        topics = self._take()
        assert self._angle is not None
        assert self._force is not None
        with self._lock:
            if self._enabled:
                self._send(lambda commands: commands.tick(self._clock()))
        refusals = (topics.joint.refusal, topics.wrench.refusal)
        complaints = tuple(refusal for refusal in refusals if refusal is not None)
        at, force = self._angle, self._force
        return Sample(at.time, *at.value, None, None, force.time, force.value, complaints)

    def enable(self) -> None:
        """Take commands, and hold where it is."""
        topics, limits = self._take(), self.limits
        assert self._angle is not None
        angle = self._angle.value[0]
        if not limits.angle_min - 1e-3 <= angle <= limits.angle_max + 1e-3:
            raise DeviceError(f"the fin is at {angle:.3f} rad, beyond {limits.angle_min:.3f} to "
                              f"{limits.angle_max:.3f} rad; bring it back by its own driver")  # fmt: skip
        if not topics.commands.publisher.readers():
            raise DeviceError(f"nobody reads {self.config.command_topic}: commands would go nowhere; start the driver, "
                              "and check the topic's type")  # fmt: skip
        with self._lock:
            if self.config.stop_release:
                self._send_stop(False)
            self._enabled = True
            hold = Target(self._sign * angle, limits.velocity_min)
            self._send(lambda commands: commands.send(hold, hold.angle, self._clock()))

    def command(self, target: Target) -> None:
        """Go there from now on."""
        trip = check_target(target, self.limits)
        if trip is not None:
            raise CommandError(trip.reason)
        with self._lock:
            if not self._enabled or self._angle is None:
                raise DeviceError("the fin is not enabled; enable it before it is commanded")
            aim, measured = Target(self._sign * target.angle, target.velocity), self._sign * self._angle.value[0]
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
            self._take()
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

    def _take(self) -> _Topics:
        """Take what has come; raises DeviceError where the machine is closed."""
        topics = self._topics
        if topics is None:
            raise DeviceError("the machine is closed; open it first")
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
        return topics

    def _send(self, message: Callable[[JointCommands | FlipperCommands], None]) -> None:
        """A message that moves; a stop in between, by a signal, has the last word."""
        if self._topics is not None:
            message(self._topics.commands)
        if not self._enabled:
            self._brake(was_enabled=True)

    def _send_stop(self, stop: bool) -> bool:
        """Ask the driver to stop, or take that back, where it has a topic for it; returns whether somebody reads it."""
        if self._topics is None or self._topics.stop is None:
            return False
        self._topics.stop.send(self._messages.encode(self._messages.make(BOOL, stop)))
        return self._topics.stop.readers() > 0

    def _brake(self, was_enabled: bool) -> None:
        with contextlib.suppress(Exception):
            if self._send_stop(True):
                return
        with contextlib.suppress(Exception):
            if was_enabled and self._topics is not None and self._angle is not None:
                self._topics.commands.hold(self._sign * self._angle.value[0])
