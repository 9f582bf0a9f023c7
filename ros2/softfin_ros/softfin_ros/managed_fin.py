"""A fin that moves only while it is active. Does not import rclpy.

One object exists as long as the node, and so does its `EmergencyStop`, which remembers every stop.
The thread of `run` (the loop) is the only one that moves the fin and publishes; other threads make
requests, which wait until they are done and raise RigError with the reason if they fail.
"""

import contextlib
import threading
import time
from pathlib import Path
from typing import Literal

from softfin.core.errors import RigError, SafetyStop, SoftfinError
from softfin.rig.loop import ActionResult
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.inputs import EmergencyStop
from softfin.rig.session import SessionState, in_one_line
from softfin.rig.stop import SIGNAL_CHECK_S, StopRequest, stopped_by_signals
from softfin.stages.driving import NodeDrive
from softfin_ros.status import FinStatus

DEACTIVATED = "deactivated"
"""Cause of a stop that is part of the life cycle, so it is not remembered."""

RESET = "call the service ~/reset first"

SILENCE_S = 1.0
"""Time without `read_stop` after which the fin is stopped, because nobody could stop it [s]."""

ZeroState = Literal["measured", "requested", "measuring"]


class ManagedFin:
    """The states of a fin: unconfigured, inactive (no device is open, nothing is sent), active
    (moves) and stopped (inactive until `reset`)."""

    def __init__(self, emergency_stop: EmergencyStop, status: FinStatus) -> None:
        self._emergency_stop = emergency_stop
        self._status = status
        self._driven: NodeDrive | None = None
        self._recordings = Path()
        self._changed = threading.Condition()
        """Guards the attributes below."""
        self._request = StopRequest()
        """Request to end the current or next motion."""
        self.is_wanted = False
        """Whether the fin is to move; false again when the motor is off."""
        self._is_active = False
        """Whether the motor is powered."""
        self._is_over = False
        """Whether `run` has ended or is to end."""
        self._failure = ""
        """Reason why the last activation failed."""
        self._zero: ZeroState = "measured"
        self._heard_s = time.monotonic()
        """Time of the last call of `read_stop` [s]."""

    @property
    def state(self) -> SessionState:
        """State of the fin."""
        if self._is_active:
            return "active"
        if self._emergency_stop.reason() is not None:
            return "stopped"
        return "unconfigured" if self._driven is None else "inactive"

    def run(self, signals: StopRequest) -> None:
        """Move the fin whenever it is activated, until a stop signal or `end`. Use the main thread,
        because other threads receive no signals; `signals` is set by those before this call and
        between two motions."""
        try:
            while not (self._is_over or signals.trip):
                self._run_once(signals)
        except Exception as error:
            self._emergency_stop.stop(in_one_line(error, "the loop of the node failed"))
        finally:
            with self._changed:
                self._is_over = True
                self.is_wanted = False
                self._changed.notify_all()
            with contextlib.suppress(Exception):
                self._publish()

    def end(self, reason: str) -> None:
        """Stop the fin if it moves, and end `run`."""
        self._is_over = True
        self.stop(reason)

    def configure(self, driven: NodeDrive, recordings: Path) -> None:
        """Set what the next activation moves; its recording is `recordings` followed by the
        date."""
        self._driven = driven
        self._recordings = recordings

    def release(self) -> None:
        """Deactivate, and forget the controller."""
        self.deactivate()
        self._driven = None

    def activate(self) -> None:
        """Open the devices, power the motor and start the controller."""
        with self._changed:
            # This also reads the stop topic.
            if (reason := self._emergency_stop.reason()) is not None:
                raise RigError(f"{reason}; {RESET}")
            if self._is_over or self._driven is None:
                raise RigError("the node is unconfigured or has ended; configure or restart it")
            self._failure = ""
            self._heard_s = time.monotonic()
            self.is_wanted = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_active or not self.is_wanted)
            if not self._is_active:
                raise RigError(self._emergency_stop.reason() or self._failure or DEACTIVATED)

    def deactivate(self) -> None:
        """Brake and disable the motor, and close the devices; a stop that the drive does not
        confirm is remembered."""
        with self._changed:
            if self.is_wanted:
                self._request.ask(DEACTIVATED, "deactivated by the life cycle of the node")
                self._changed.wait_for(lambda: not self.is_wanted)

    def stop(self, reason: str) -> None:
        """Stop the fin if it moves, and refuse activations until `reset`; does not wait."""
        self._emergency_stop.stop(reason)
        self.read_stop()
        with self._changed:
            self._changed.notify_all()

    def read_stop(self) -> None:
        """Read the stop topic, and stop the fin if a stop is remembered. The executor calls this
        for each message and at least every `SILENCE_S`; otherwise, the loop stops the fin."""
        self._heard_s = time.monotonic()
        reason = self._emergency_stop.reason()
        if reason is not None:
            with self._changed:
                # A command between now and the next tick of the loop is refused, too.
                if self.is_wanted:
                    self._request.ask("emergency_stop", reason)

    def reset(self) -> None:
        """Forget a stop, unless the stop topic still requests it."""
        with self._changed:
            if self.is_wanted:
                raise RigError("the fin is active; deactivate it first")
            self._emergency_stop.reset()
            self._changed.notify_all()

    def zero(self) -> None:
        """Rest, measure the offset of the force sensor again, and restart the controller."""
        with self._changed:
            if not self._is_active:
                raise RigError(f"the fin is {self.state}; activate it, which also zeroes the force")
            self._zero = "requested"
            self._changed.wait_for(lambda: self._zero == "measured" or not self.is_wanted)
            if not self.is_wanted:
                raise RigError(self._emergency_stop.reason() or DEACTIVATED)

    def _run_once(self, signals: StopRequest) -> None:
        """Wait for an activation, and move until it ends."""
        request = self._request
        with stopped_by_signals(request):
            # From here on, `signals` does not change.
            while not (self.is_wanted or self._is_over or request.trip or signals.trip):
                self._publish()
                with self._changed:
                    if not (self.is_wanted or self._is_over):
                        # Without a timeout, a signal that another thread receives would not wake
                        # us, and the stop topic would not be read.
                        self._changed.wait(SIGNAL_CHECK_S)
            if self.is_wanted and signals.trip is None:
                self._move(request)
        if request.ends_program:
            self._is_over = True

    def _move(self, request: StopRequest) -> None:
        """Move until a stop or a failure, and remember it unless it was planned."""
        outcome = "the motion was interrupted"
        is_stop = True
        try:
            assert self._driven is not None, "activate has checked this"
            bag = vacant_recording(self._recordings)
            driven = self._driven._replace(drive=self._driven.drive._replace(bag=bag))
            observers = (self._note_tick,)
            driven.run(request, None, observers, "call ~/stop to stop the fin", self._note_action)
        except SafetyStop as error:
            outcome = str(error)
            is_stop = not is_planned(error, request)
        except Exception as error:
            outcome = in_one_line(error, "moving the fin failed")
            # A device that cannot be opened may be tried again without a reset.
            is_stop = self._is_active or not isinstance(error, SoftfinError)
        finally:
            with self._changed:
                if is_stop:
                    self._emergency_stop.stop(outcome)
                self._failure = outcome
                self._request = StopRequest()
                self.is_wanted = False
                self._is_active = False
                self._zero = "measured"
                self._changed.notify_all()

    def _note_tick(self, sample: Sample, target: Target | None) -> None:
        """As an observer of the session, note when the motor is powered, and publish the state."""
        if target is not None and not self._is_active:
            with self._changed:
                self._is_active = True
                self._changed.notify_all()
        silence_s = time.monotonic() - self._heard_s
        if silence_s > SILENCE_S:
            self._emergency_stop.stop(f"no answer from the ROS executor for {silence_s:.1f} s")
        self._status.add(sample)
        self._publish()

    def _note_action(self, result: ActionResult) -> bool:
        """Return whether the force is to be zeroed now."""
        self._status.estimate = result.estimate
        with self._changed:
            is_requested = self._zero == "requested"
            self._zero = "measuring" if is_requested else "measured"
            self._changed.notify_all()
        return is_requested

    def _publish(self) -> None:
        """Read the stop topic, and publish what has changed."""
        self._status.update(self.state, self._emergency_stop.reason() or "")


def is_planned(error: SafetyStop, request: StopRequest) -> bool:
    """Return whether a confirmed stop was a deactivation or a stop signal."""
    causes = {DEACTIVATED}
    if request.is_by_signal and request.trip is not None:
        causes.add(request.trip.cause)
    return error.is_confirmed and error.cause in causes


def vacant_recording(path: Path) -> Path:
    """Return a new path for a recording, with the date; two within one second get different
    names."""
    stem = f"{path}-{time.strftime('%Y%m%d-%H%M%S')}"
    bag = Path(f"{stem}.mcap")
    number = 1
    while bag.exists():
        number += 1
        bag = Path(f"{stem}-{number}.mcap")
    return bag
