"""A fin made of topics: any driver that publishes a joint and a wrench, and takes commands, in place of our devices.

Tried with drivers of our own making on loopback; it has met neither a real driver nor a node of ROS 2.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Literal

from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import CommandError, DeviceError
from softfin.core.quantities import Limits
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig.frame import rotation
from softfin.rig.machine import Sample, Target, Wrench
from softfin.rig.ros2.commands import Commands, JointCommands
from softfin.rig.ros2.intake import Intake, Told
from softfin.rig.ros2.messages import BOOL, JOINT, WRENCH, Messages, TopicName, joint_of, turned, wrench_of
from softfin.rig.ros2.transport import Outlet, Transport, TransportConfig, open_transport
from softfin.rig.ucat import FlipperCommands, FlipperConfig

ROUNDING = 1e-3
"""How far beyond a limit a command may be by rounding [rad, rad/s]."""

LOCK_S = 0.02
"""Longest that a stop waits for a command that is going out [s]; over DDS that takes 5 ms at most."""


class LimitsConfig(Configuration):
    """The commands that the fin takes."""

    angle_min_rad: float = Field(ge=-math.pi, le=math.pi)
    """[rad]"""
    angle_max_rad: float = Field(ge=-math.pi, le=math.pi)
    """[rad]"""
    velocity_min_rad_s: PositiveFloat
    """Slowest profile velocity [rad/s]."""
    velocity_max_rad_s: PositiveFloat
    """Fastest profile velocity [rad/s]."""

    @model_validator(mode="after")
    def _ordered(self) -> "LimitsConfig":
        for name, low, high in (("angle", self.angle_min_rad, self.angle_max_rad),
                                ("velocity", self.velocity_min_rad_s, self.velocity_max_rad_s)):  # fmt: skip
            if not low < high:
                raise ValueError(f"{name}: min {low:g} is not below max {high:g}")
        if problem := self.limits().problem():
            raise ValueError(problem)
        return self

    def limits(self) -> Limits:
        """As every plant tells them."""
        return Limits(self.angle_min_rad, self.angle_max_rad, self.velocity_min_rad_s, self.velocity_max_rad_s)


class Ros2PlantConfig(Configuration):
    """Which topics are the fin. What depends on the robot has no default."""

    joint_topic: TopicName
    """sensor_msgs/JointState with the shaft's angle, at 100 Hz or more."""
    joint_name: str = Field(min_length=1)
    """The fin's name in it."""
    wrench_topic: TopicName
    """geometry_msgs/WrenchStamped of the fin on its mount, at 100 Hz or more, filtered for 100 Hz by its driver."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """What is +x (thrust that pushes the robot forward) and what is +y, in the sensor's own axes: ``y,-x``."""
    command_topic: TopicName
    """sensor_msgs/JointState with position and velocity, or the flipper's message."""
    flipper: FlipperConfig | None = None
    """For robots of the U-CAT family: commands as flipper messages."""
    negate_angle: bool = False
    """The driver's angles, velocities and commands count the other way round."""
    limits: LimitsConfig
    """The commands that the fin takes."""
    stop_topic: TopicName | None = None
    """std_msgs/Bool that the driver brakes and disables its motor on. None: a stop is a command to hold."""
    stop_release: bool = False
    """Send false on the stop topic when the fin is enabled: only where that takes back nobody else's stop."""
    best_effort: bool = True
    """Read joint and wrench as sensor data: it matches every publisher, and a lost reading is not sent again."""
    wait_s: PositiveFloat = Field(default=5.0, le=120)
    """Longest wait for the first messages [s]."""
    connection: TransportConfig = Field(default_factory=TransportConfig)
    """How to reach the driver."""


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
        self._transport: Transport | None = None
        self._joint: Intake[tuple[float, float | None]] | None = None
        self._wrench: Intake[Wrench] | None = None
        self._commands: Commands | None = None
        self._stop: Outlet | None = None
        self._stops: dict[bool, bytes] = {}
        self._enabled = False
        self._angle: Told[tuple[float, float]] | None = None
        self._force: Told[Wrench] | None = None
        self._counted: dict[str, int] = {}

    @property
    def limits(self) -> Limits:
        """As the configuration says."""
        return self.config.limits.limits()

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of the connection."""
        return () if self._transport is None else self._transport.notes

    @property
    def doubt(self) -> str | None:
        """Whatever was sent: whether the motor is off lies with its driver."""
        return "whether the motor is off lies with its driver; keep a switch of its supply at hand"

    def open(self) -> None:
        """Wait until joint and wrench speak; nothing is sent."""
        self.close()
        config = self.config
        try:
            messages = Messages(config.flipper.definitions if config.flipper else None)
            transport = self._transport = self._opener(config.connection, messages)
            turn = rotation(config.frame)
            self._joint = Intake(
                transport, messages, config.joint_topic, JOINT,
                lambda message: joint_of(message, config.joint_name), best_effort=config.best_effort,
            )  # fmt: skip
            self._wrench = Intake(
                transport, messages, config.wrench_topic, WRENCH,
                lambda message: turned(wrench_of(message), turn), best_effort=config.best_effort,
            )  # fmt: skip
            self._commands = self._made(transport, messages)
            if config.stop_topic is not None:
                self._stop = transport.publish(config.stop_topic, BOOL)
                self._stops = {asked: messages.encode(messages.make(BOOL, asked)) for asked in (True, False)}
            self._await_first()
        except BaseException:
            self.close()
            raise

    def read(self) -> Sample:
        """The newest of both topics."""
        joint, wrench = self._open()
        self._take(joint, wrench)
        if self._angle is None or self._force is None:
            raise DeviceError("nothing has been read yet; open the machine first")
        with self._lock:
            if self._enabled:
                self._say(lambda commands: commands.tick(self._clock()))
        (angle, velocity), complaints = self._angle.value, tuple(
            intake.refusal for intake in (joint, wrench) if intake.refusal is not None
        )  # fmt: skip
        return Sample(self._angle.time, angle, velocity, None, None, self._force.time, self._force.value, complaints)

    def enable(self) -> None:
        """Hold where it is."""
        joint, wrench = self._open()
        assert self._commands is not None
        self._take(joint, wrench)
        angle, limits = self._measured(), self.limits
        if not limits.angle_min - ROUNDING <= angle <= limits.angle_max + ROUNDING:
            raise DeviceError(f"the fin is at {angle:.3f} rad, beyond {limits.angle_min:.3f} to "
                              f"{limits.angle_max:.3f} rad; bring it back by its own driver")  # fmt: skip
        if not self._commands.listeners():
            raise DeviceError(f"nobody reads {self.config.command_topic}: commands would go nowhere; start the driver, "
                              "and check the topic's type")  # fmt: skip
        with self._lock:
            if self._stop is not None and self.config.stop_release:
                self._stop.send(self._stops[False])
            self._enabled = True
            hold = Target(self._sign * angle, limits.velocity_min)
            self._say(lambda commands: commands.send(hold, hold.angle, self._clock()))

    def command(self, target: Target) -> None:
        """Go there from now on."""
        limits = self.limits
        for what, value, low, high in (
            ("angle", target.angle, limits.angle_min, limits.angle_max),
            ("velocity", target.velocity, limits.velocity_min, limits.velocity_max),
        ):
            if not low - ROUNDING <= value <= high + ROUNDING:
                raise CommandError(f"{what} {value:g}: this fin takes {low:g} to {high:g}; train within them")
        with self._lock:
            if not self._enabled:
                raise DeviceError("the fin is not enabled; enable it before it is commanded")
            aim, measured = Target(self._sign * target.angle, target.velocity), self._sign * self._measured()
            self._say(lambda commands: commands.send(aim, measured, self._clock()))

    def stop(self) -> None:
        """See the class for what it can do and cannot."""
        # A command that hangs in its transport must not keep the watchdog from its stop.
        alone = self._lock.acquire(timeout=LOCK_S)
        try:
            moving, self._enabled = self._enabled, False
            if moving or self._stop is not None:
                self._brake(moving)
        finally:
            if alone:
                self._lock.release()

    def close(self) -> None:
        """A machine that was not enabled sends nothing."""
        with self._lock:
            if self._enabled:
                self.stop()
            self._counted = self.counters()
            transport, self._transport = self._transport, None
            self._joint = self._wrench = self._commands = self._stop = None
            self._angle = self._force = None
        if transport is not None:
            transport.close()

    def counters(self) -> dict[str, int]:
        """Of both topics; after `close`, what they were."""
        joint, wrench = self._joint, self._wrench
        if joint is None or wrench is None:
            return self._counted
        return {
            f"{name}_{what}": getattr(intake, what)
            for name, intake in (("joint", joint), ("wrench", wrench))
            for what in ("received", "refused", "not_newer")
        }

    def _made(self, transport: Transport, messages: Messages) -> Commands:
        config = self.config
        if config.flipper is not None:
            return FlipperCommands(transport, messages, config.command_topic, config.flipper)
        fastest = self.limits.velocity_max
        return JointCommands(transport, messages, config.command_topic, config.joint_name, fastest)

    def _await_first(self) -> None:
        joint, wrench = self._open()
        deadline = time.monotonic() + self.config.wait_s
        while self._angle is None or self._force is None:
            self._take(joint, wrench)
            if time.monotonic() > deadline:
                break
            time.sleep(0.002)
        missing = [intake for intake, told in ((joint, self._angle), (wrench, self._force)) if told is None]
        if missing:
            raise DeviceError(self._silence(missing[0]))

    def _silence(self, intake: Intake[tuple[float, float | None]] | Intake[Wrench]) -> str:
        if intake.refusal is not None:
            return intake.refusal
        assert self._transport is not None
        there = self._transport.topics()
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in list(there.items())[:20]) or "nothing"
        head = f"{intake.topic}: no {intake.kind} in {self.config.wait_s:g} s; there is {listed}"
        return f"{head}; start its driver, correct the topic, or the domain (ROS_DOMAIN_ID) and the network"

    def _open(self) -> tuple["Intake[tuple[float, float | None]]", "Intake[Wrench]"]:
        joint, wrench = self._joint, self._wrench
        if joint is None or wrench is None:
            raise DeviceError("the machine is closed; open it first")
        return joint, wrench

    def _take(self, joint: "Intake[tuple[float, float | None]]", wrench: "Intake[Wrench]") -> None:
        for told in joint.take():
            angle, velocity = told.value
            angle *= self._sign
            if velocity is None:
                velocity = self._difference(angle, told.time)
            else:
                velocity *= self._sign
            self._angle = Told(told.time, told.received, (angle, velocity))
        for force in wrench.take():
            self._force = force

    def _difference(self, angle: float, at: float) -> float:
        """The velocity of a driver that tells none: from the reading before."""
        if self._angle is None or at <= self._angle.time:
            return 0.0
        return (angle - self._angle.value[0]) / (at - self._angle.time)

    def _measured(self) -> float:
        if self._angle is None:
            raise DeviceError("the fin's angle is not known; open the machine first")
        return self._angle.value[0]

    def _say(self, message: Callable[[Commands], None]) -> None:
        """A message that moves; a stop in between, by a signal, has the last word."""
        if self._commands is not None:
            message(self._commands)
        if not self._enabled:
            self._brake()

    def _brake(self, moving: bool = True) -> None:
        with contextlib.suppress(Exception):
            if self._stop is not None:
                self._stop.send(self._stops[True])
                if self._stop.listeners():
                    return
        with contextlib.suppress(Exception):
            if moving and self._commands is not None and self._angle is not None:
                self._commands.hold(self._sign * self._angle.value[0])
