"""A fin with a life cycle: it moves only while it is active, and can be stopped, zeroed and reset
from other threads. Does not import rclpy."""

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError, SafetyStop, SoftfinError
from softfin.core.option_types import Force
from softfin.rig.arming import Arming
from softfin.rig.loop import ActionResult
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.connection import Transport
from softfin.rig.session import SessionState
from softfin.rig.stop import SIGNAL_CHECK_S, StopRequest, stopped_by_signals
from softfin.stages.driving import Drive, NodeDrive


class FinParameters(Configuration):
    """Parameters of the node; ROS 2 has no None, so 0 and empty texts replace it."""

    controller: str = ""
    """Controller folder."""
    plant: str = "rig"
    """The fin: rig or ros2, optionally followed by :FILE."""
    reference: Force = (0.0, 0.0)
    """Reference force (x, y) while the topic has no recent message [N]."""
    strict: bool = False
    """Reject unreachable references instead of tracking the nearest reachable one."""
    feedback: bool = False
    """Add feedback from force and torque, which corrects for changes of the fin."""
    folder: str = "."
    """Folder of the recordings; each activation writes one."""
    arm: bool = False
    """Allow the real fin to move when the node is activated."""
    autostart: bool = False
    """Configure and activate the node when it starts."""
    joint_name: str = "fin"
    """Name of the joint in the messages."""
    frame: str = "fin_mount"
    """Frame of the forces; +x is forward thrust on the robot."""
    reference_timeout_s: float = Field(default=1.0, ge=0)
    """Age after which a reference expires [s]; 0: never."""
    reference_lost: Literal["keep", "zero", "stop"] = "stop"
    """Reaction to an expired reference, as in `NodeConfig`."""
    reference_limit_n: float = Field(default=0.0, ge=0)
    """Maximum reference on either axis [N]; 0: the default of `NodeConfig`."""

    def node_config(self, topics: Mapping[str, str]) -> NodeConfig:
        """Return the configuration of the node with these topics, keyed by field name."""
        return NodeConfig.build(
            {
                **topics,
                "joint_name": self.joint_name,
                "frame": self.frame,
                "reference_timeout_s": self.reference_timeout_s or None,
                "reference_lost": self.reference_lost,
                "reference_limit_n": self.reference_limit_n or None,
                "feedback": {} if self.feedback else None,
            },
            "parameters",
        )

    def connect(self, transport: Transport, topics: Mapping[str, str], name: str) -> "ManagedFin":
        """Load the controller and create the topics; `name` is the name of the fin in the names of
        its recordings."""
        if not self.controller:
            raise ConfigurationError("parameter controller: missing; set it to a controller folder")
        config = self.node_config(topics)
        # The activation of the node confirms the motion, because launch files have no terminal.
        arming = Arming(self.arm, yes=True)
        drive = Drive.prepare(
            self.controller, self.plant, arming, None, None, config.feedback, overwrite=False
        )
        driven = NodeDrive.connect(drive, transport, config, self.reference, self.strict)
        return ManagedFin(driven, Path(self.folder), name)


DEACTIVATED = "deactivated by the life cycle of the node"

ZeroState = Literal["measured", "requested", "measuring"]


class ManagedFin:
    """A fin that moves in the thread of `run` and takes requests from other threads.

    Its states are inactive (no device is open, nothing is sent), active (moves) and stopped
    (inactive until `reset`). The requests wait until they are done and raise SoftfinError with the
    reason if they fail.
    """

    def __init__(self, driven: NodeDrive, folder: Path, name: str) -> None:
        """Start inactive; recordings are `folder`/`name`-DATE.mcap."""
        self._driven = driven
        self._folder = folder
        self._name = name
        self._stop = StopRequest()
        self._changed = threading.Condition()
        self.state: SessionState = "inactive"
        """State of the fin, which other threads may read."""
        self.reason = ""
        """Reason why the fin is stopped, or why it could not be activated."""
        self._is_wanted = False
        """Whether the fin is to move; false again when the motor is off."""
        self._is_over = False
        self._zero: ZeroState = "measured"

    def run(self) -> bool:
        """Move the fin whenever it is activated, until `shut_down` or a stop signal; return whether
        it was a signal. Use the main thread, because other threads receive no signals."""
        try:
            with stopped_by_signals(self._stop):
                while not (self._is_over or self._stop.is_by_signal):
                    if self._is_wanted:
                        self._move()
                    else:
                        self._driven.node.diagnose_if_due()
                        with self._changed:
                            self._changed.wait_for(lambda: self._is_wanted, SIGNAL_CHECK_S)
            return self._stop.is_by_signal
        finally:
            with self._changed:
                self._is_over = True
                self._is_wanted = False
                self._changed.notify_all()

    def activate(self) -> None:
        """Open the devices, power the motor and start the controller."""
        with self._changed:
            if self.state == "stopped":
                raise RigError(f"{self.reason}; call the service ~/reset first")
            self.reason = ""
            self._is_wanted = not self._is_over
            self._changed.notify_all()
            self._changed.wait_for(lambda: self.state == "active" or not self._is_wanted)
            if self.state != "active":
                raise RigError(self.reason or "the node has ended; start it again")

    def deactivate(self) -> None:
        """Brake and disable the motor, and close the devices."""
        with self._changed:
            if self._is_wanted:
                self._stop.ask("deactivated", DEACTIVATED)
                self._changed.wait_for(lambda: not self._is_wanted)

    def shut_down(self) -> None:
        """Deactivate, and end `run`."""
        self.deactivate()
        self._is_over = True

    def stop(self, reason: str) -> None:
        """Request a stop, after which the fin cannot be activated until `reset`; does not wait."""
        with self._changed:
            if self._is_wanted:
                self._stop.ask("emergency_stop", reason)
            else:
                self._set("stopped", reason)

    def reset(self) -> None:
        """Allow activation after a stop, unless the stop topic still requests it."""
        with self._changed:
            if self._is_wanted:
                raise RigError("the fin is active; deactivate it first")
            self._driven.node.reset_stop()
            self._set("inactive", "")

    def zero(self) -> None:
        """Rest, measure the offset of the force sensor again, and restart the controller."""
        with self._changed:
            if self.state != "active":
                raise RigError(f"the fin is {self.state}; activate it, which also zeroes the force")
            self._zero = "requested"
            self._changed.wait_for(lambda: self._zero == "measured" or not self._is_wanted)
            if not self._is_wanted:
                raise RigError(self.reason or DEACTIVATED)

    def _move(self) -> None:
        """Move until a stop or a failure."""
        drive = self._driven.drive
        machine = drive.robot.machine
        # A machine that can never confirm a stop may still be deactivated.
        never_confirmed = machine.stop_unconfirmed
        bag = self._folder / f"{self._name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        state: SessionState = "inactive"
        reason = ""
        self._zero = "measured"
        try:
            self._driven._replace(drive=drive._replace(bag=bag)).run(
                self._stop, None, self._note_tick, "call ~/stop to stop the fin", self._note_action
            )
        except SoftfinError as error:
            reason = str(error)
            if isinstance(error, SafetyStop) or self.state == "active":
                state = "stopped"
        if DEACTIVATED in reason and machine.stop_unconfirmed in (None, never_confirmed):
            state = "inactive"
            reason = ""
        with self._changed:
            if not self._stop.is_by_signal:
                self._stop.trip = None
                self._stop.is_obeyed = False
            self._is_wanted = False
            self._set(state, reason)
            self._changed.notify_all()

    def _note_tick(self, sample: Sample, target: Target | None) -> None:
        if target is not None and self.state == "inactive":
            with self._changed:
                self.state = "active"
                self._changed.notify_all()

    def _note_action(self, result: ActionResult) -> bool:
        """Return whether the force is to be zeroed now."""
        with self._changed:
            is_requested = self._zero == "requested"
            self._zero = "measuring" if is_requested else "measured"
            self._changed.notify_all()
        return is_requested

    def _set(self, state: SessionState, reason: str) -> None:
        self.state = state
        self.reason = reason
        self._driven.node.announce(state, reason if state == "stopped" else "")
