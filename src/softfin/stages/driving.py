"""Runs a controller on a real fin, with live or recorded references or as a ROS 2 node. No JAX."""

import contextlib
import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeAlias

import numpy as np

from softfin.control.controller import LoadedController
from softfin.control.feedback import Estimate, Feedback, FeedbackConfig
from softfin.control.feedback_notes import FeedbackNotes
from softfin.control.references import resolve_reference
from softfin.control.store import load_controller, load_feedback
from softfin.core.configuration import Configuration, configure
from softfin.core.errors import ConfigurationError, RigError, SafetyStop
from softfin.core.json_object import JsonObject
from softfin.core.option_types import (
    CONNECTION,
    CONTROLLER,
    FILE,
    FORCE,
    PLANT,
    Config,
    Force,
    PathLike,
)
from softfin.core.power import describe_powers, mean_powers
from softfin.core.quantities import RATE_HZ
from softfin.core.result import Result
from softfin.gaits.reachable import force_decimals
from softfin.rig.arming import STATUS, Arming, listen_on_terminal, say
from softfin.rig.loop import (
    ActionResult,
    LiveReference,
    ReferenceSource,
    recorded_reference,
    run_controller,
)
from softfin.rig.machine import machine_clock, torque_constant
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.ros2.config import NodeConfig, TransportConfig
from softfin.rig.safety import Guard
from softfin.rig.session import Observer, Session, mean_force
from softfin.rig.shaft_torque import ShaftTorque
from softfin.rig.stop import StopRequest
from softfin.stages.machines import find_robot
from softfin.storage import artifact as artifacts
from softfin.storage.paths import check_reference_file

if TYPE_CHECKING:
    from softfin.rig.ros2.connection import Transport
    from softfin.rig.ros2.inputs import EmergencyStop
    from softfin.rig.ros2.node import RosNode

STOP_KEY = "press Enter alone to stop the fin"

AfterAction: TypeAlias = Callable[[ActionResult], bool]
"""Function that receives each action and returns whether the force is to be zeroed again."""


class RunConfig(Configuration):
    """Configuration of a run."""

    feedback: FeedbackConfig | None = None
    """Feedback, which corrects the reference for changes of the fin; None for no feedback."""


class Drive(NamedTuple):
    """A controller for a real fin, with the duration and the file of the recording."""

    controller: LoadedController
    acting: LoadedController | Feedback
    """The controller, with feedback if it is enabled."""
    robot: RobotSetup
    arming: Arming
    seconds: int | None
    bag: Path | None

    @classmethod
    def prepare(
        cls,
        controller: PathLike,
        plant: str,
        arming: Arming,
        seconds: int | None,
        bag: PathLike | None,
        feedback: FeedbackConfig | None,
        overwrite: bool,
    ) -> "Drive":
        """Load the controller and the machine and check that they match; nothing is opened yet."""
        if seconds is not None and seconds < 1:
            raise ConfigurationError(
                f"--seconds {seconds}: must be at least 1; omit it to run until you stop it"
            )
        if bag is not None:
            bag = Path(bag)
            if bag.suffix != ".mcap":
                raise ConfigurationError(f"--bag {bag}: must end in .mcap")
            artifacts.check_file(bag, overwrite, "--bag")
        loaded = load_controller(Path(controller))
        robot = find_robot(plant)
        robot.check_fits(str(controller), loaded.limits, loaded.artifact.fin)
        settings = robot.feedback_settings(feedback)
        acting = load_feedback(Path(controller), loaded, settings)
        return cls(loaded, acting, robot, arming, seconds, bag)

    def run(
        self,
        references: ReferenceSource,
        line: Callable[[str], None] | None,
        stop: StopRequest | None = None,
        observers: Sequence[Observer] = (),
        keys: str = STOP_KEY,
        after_action: AfterAction = lambda result: False,
    ) -> Result:
        """Ask for confirmation, then move and record.

        `line` is called with each typed line; None: there is no keyboard. `keys` describes the
        possible input. If `after_action` returns True, the fin goes to rest, and the controller
        starts again with a new offset of the force sensor. Returns the path
        of the recording and the errors over its last window, which are also printed if the fin is
        stopped.
        """
        machine = self.robot.machine
        bag = self.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
        training_range = self.controller.artifact.training_range
        guard = Guard(self.robot.safety, machine.limits, training_range)
        stop = stop or StopRequest()
        summary: JsonObject = {}
        with (
            _said_when_stopped(bag, summary),
            Session(machine, guard, stop=stop, observers=observers, warn=say) as session,
        ):
            self.arming.confirm(self.robot)
            if not any(training_range or ()):
                say(
                    "controller: no training range stored, so softfin cannot detect when the fin "
                    "leaves it"
                )
            if line is not None:
                listen_on_terminal(stop, line)
            # An existing recording is replaced only after the confirmation.
            bag.unlink(missing_ok=True)
            session.stop_on_signals()
            with session.recording(bag):
                session.activate()
                needs_zero = True
                while needs_zero:
                    zero = session.rest(self.robot.settle_s)
                    results = self._follow(session, references, zero, summary, keys)
                    needs_zero = any(after_action(result) for result in results)
                session.deactivate()
        result = {
            "bag": str(bag),
            **summary,
            "clock": session.pace.to_dict(),
            "counters": machine.counters(),
        }
        return Result(result, _described(bag, summary))

    def _follow(
        self,
        session: Session,
        references: ReferenceSource,
        zero: Force,
        summary: JsonObject,
        keys: str,
    ) -> Iterator[ActionResult]:
        """Run the controller, yield each action and show its state every second; `summary` receives
        the errors over the last window."""
        controller = self.acting
        reachable = controller.reachable
        decimals = 2 if reachable is None else force_decimals(reachable.reach_n)
        window: list[ActionResult] = []
        ticks = printed = 0
        notes = FeedbackNotes(controller)
        clock = controller.clock
        actions = None if self.seconds is None else clock.actions_within(self.seconds * RATE_HZ)
        uses = controller.config.uses if isinstance(controller, Feedback) else None
        torque = ShaftTorque(session, say, uses)
        for result in run_controller(session, controller, references, actions, zero, torque):
            window = [*window, result][-clock.window_actions :]
            x, y = mean_force([sample for each in window for sample in each.samples])
            x = x - zero[0]
            y = y - zero[1]
            ticks += len(result.samples)
            if ticks - printed >= RATE_HZ:
                printed = ticks
                reference = ", ".join(f"{force:+.{decimals}f}" for force in result.reference)
                mean = ", ".join(f"{force:+.{decimals + 1}f}" for force in (x, y))
                line = (
                    f"{ticks / RATE_HZ:7.1f} s  target ({reference}) N  mean ({mean}) N  "
                    f"angle {result.samples[-1].angle:+.2f} rad"
                )
                if result.estimate is not None:
                    line += f"  {_described_estimate(result.estimate, decimals + 1)}"
                try:
                    STATUS.show(line, f"{keys}: ")
                except OSError as error:
                    # The terminal was closed, or the program that reads the output has exited.
                    session.stop_request.ask(
                        "emergency_stop", f"the output is no longer being read ({error.strerror})"
                    )
            if result.estimate is not None:
                summary |= _estimate_summary(result.estimate)
                for note in notes.on(result.estimate):
                    say(note)
            errors = [
                abs(mean - asked) for mean, asked in zip((x, y), result.reference, strict=True)
            ]
            summary |= {
                "seconds": ticks / RATE_HZ,
                "window_s": clock.window_ticks / RATE_HZ,
                "error_x_n": round(errors[0], 4),
                "error_y_n": round(errors[1], 4),
            }
            means_w = np.mean([each.power for each in window], axis=0).tolist()
            if powers := mean_powers(math.hypot(x, y), means_w):
                summary["power"] = powers
            yield result


class NodeDrive(NamedTuple):
    """A drive whose references come from a topic."""

    drive: Drive
    node: "RosNode"
    otherwise: Force
    """Reference while the topic has no recent message [N]."""

    @classmethod
    def connect(
        cls,
        drive: Drive,
        transport: "Transport",
        topics: NodeConfig,
        reference: Force,
        strict: bool,
        emergency_stop: "EmergencyStop | None" = None,
    ) -> "NodeDrive":
        """Create the topics; `strict` rejects unreachable references. Raises RigError if the
        machine does not work with topics."""
        from softfin.rig.ros2.node import RosNode, default_reference_limit
        from softfin.rig.ros2.plant import Ros2Machine

        machine = drive.robot.machine
        if machine_clock(machine).is_simulated:
            raise RigError(
                f"{machine.name}: emulated in simulated time, which does not work with topics; "
                "start softfin rig emulate --real-time"
            )
        if isinstance(machine, Ros2Machine):
            machine.config.check_apart(topics)
        otherwise, warning = resolve_reference(drive.controller, reference, strict)
        node = RosNode(
            transport,
            topics,
            say,
            lambda asked: resolve_reference(drive.controller, asked, strict),
            default_limit_n=default_reference_limit(drive.controller),
            torque_constant_nm_a=torque_constant(machine),
            emergency_stop=emergency_stop,
        )
        for note in (*transport.notes, *([] if warning is None else [warning])):
            say(note)
        return cls(drive, node, otherwise)

    def run(
        self,
        stop: StopRequest,
        line: Callable[[str], None] | None,
        observers: Sequence[Observer] = (),
        keys: str = STOP_KEY,
        after_action: AfterAction = lambda result: False,
    ) -> Result:
        """Move and record as `Drive.run` does, and publish each sample."""
        self.node.forget_references()
        result = self.drive.run(
            lambda _: self.node.reference() or self.otherwise,
            line,
            stop,
            (functools.partial(self.node.observe, stop), *observers),
            keys,
            after_action,
        )
        result["counters"] |= self.node.counters()
        return result


def _described_estimate(estimate: Estimate, decimals: int) -> str:
    """Describe the true mean force estimated by feedback, with its 90% interval."""
    parts = zip(estimate.force, estimate.half_width, strict=True)
    force = ", ".join(f"{mean:+.{decimals}f} +- {half:.{decimals}f}" for mean, half in parts)
    return f"true ({force}) N"


def _estimate_summary(estimate: Estimate) -> JsonObject:
    """Return the summary entries for an estimate of the feedback."""
    return {
        "true_force_n": [round(float(force), 4) for force in estimate.force],
        "half_width_n": [round(float(half), 4) for half in estimate.half_width],
        "drift_n": [round(float(drift), 4) for drift in estimate.drift],
        "level": round(float(estimate.level), 2),
    }


@contextlib.contextmanager
def _said_when_stopped(bag: Path, summary: JsonObject) -> Iterator[None]:
    """Print the summary if the fin is stopped after the first action."""
    try:
        yield
    except SafetyStop:
        # The reason for the stop matters more than a closed terminal.
        with contextlib.suppress(OSError):
            if summary:
                say(_described(bag, summary))
        raise
    finally:
        with contextlib.suppress(OSError):
            STATUS.clear()


def _described(bag: Path, summary: JsonObject) -> str:
    power = f"; {describe_powers(summary['power'])}" if "power" in summary else ""
    return (
        f"{bag}: {summary['seconds']:.1f} s, error over the last {summary['window_s']:g} s "
        f"({summary['error_x_n']}, {summary['error_y_n']}) N{power}"
    )


def run(
    controller: Annotated[PathLike, CONTROLLER],
    *,
    plant: Annotated[str, PLANT] = "rig",
    reference: Annotated[Force | None, FORCE] = None,
    reference_file: Annotated[PathLike | None, FILE] = None,
    seconds: int | None = None,
    bag: Annotated[PathLike | None, FILE] = None,
    strict: bool = False,
    feedback: bool = False,
    config: Config = None,
    arm: bool = False,
    yes: bool = False,
    overwrite: bool = False,
) -> Result:
    """Hold reference forces on the real fin. While it runs, type X,Y and Enter for a new reference,
    or Enter alone to stop.

    Args:
        controller: Controller folder.
        plant: The fin: rig or ros2, optionally followed by :FILE.
        reference: First reference force [N], such as --reference=1,-0.5.
        reference_file: Recorded reference instead (.csv, .parquet): time_s, force_x_n, force_y_n.
        seconds: Duration [s] (default: until you stop it).
        bag: Recording to write, a ROS 2 bag (default: run-DATE.mcap).
        strict: Reject unreachable references instead of tracking the nearest reachable one.
        feedback: Add feedback from force and torque, which corrects for changes of the fin.
        config: `RunConfig`; its fields are options too, such as --feedback.uses force.
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.
        overwrite: Replace an existing recording.

    Returns:
        Path of the recording, and the errors and the power over its last window.

    Raises:
        SafetyStop: If the fin was stopped.
    """
    settings = configure(RunConfig(), config, feedback={} if feedback else None)
    if (reference is None) == (reference_file is None):
        raise ConfigurationError("use either --reference=X,Y or --reference-file FILE")
    if reference_file is not None:
        check_reference_file(Path(reference_file))
    drive = Drive.prepare(
        controller, plant, Arming(arm, yes), seconds, bag, settings.feedback, overwrite
    )

    def resolve(force: Force) -> tuple[Force, str | None]:
        return resolve_reference(drive.controller, force, strict)

    if reference is not None:
        live = LiveReference(reference, resolve, say)
        keys = f"type X,Y for a new target, or {STOP_KEY}"
        return drive.run(live, live.set_from_text, keys=keys)
    assert reference_file is not None, "checked above"
    # Imported here because reading the file needs packages that a robot may lack.
    from softfin.task.signals import read_reference_file

    rows = read_reference_file(Path(reference_file))
    forces = [(float(x), float(y)) for x, y in rows.force_n]
    recorded = recorded_reference(rows.time_s, forces, resolve, say)
    line = f"references come from the file; {STOP_KEY}"
    return drive._replace(seconds=seconds or rows.seconds).run(recorded, lambda _: say(line))


def ros2(
    controller: Annotated[PathLike, CONTROLLER],
    *,
    plant: Annotated[str, PLANT] = "rig",
    reference: Annotated[Force, FORCE],
    fin: str | None = None,
    seconds: int | None = None,
    bag: Annotated[PathLike | None, FILE] = None,
    strict: bool = False,
    feedback: bool = False,
    config: Config = None,
    connection: Annotated[TransportConfig | None, CONNECTION] = None,
    arm: bool = False,
    yes: bool = False,
    overwrite: bool = False,
) -> Result:
    """Run as a ROS 2 node: hold the reference force from a topic on the real fin, and publish every
    sample. Enter or a topic stops the fin.

    Topics, frames and timeouts are options too, e.g. --joint-topic /NAME; see docs/ros2.md.

    Args:
        controller: Controller folder.
        plant: The fin: rig or ros2, optionally followed by :FILE.
        reference: Reference force [N] while the topic has no recent message, such as
            --reference=1,-0.5.
        fin: Name of one fin of a robot; its topics are /NAME/joint_states and so on.
        seconds: Duration [s] (default: until you stop it).
        bag: Recording to write, a ROS 2 bag (default: run-DATE.mcap).
        strict: Reject unreachable references instead of tracking the nearest reachable one.
        feedback: Add feedback from force and torque, which corrects for changes of the fin.
        config: `NodeConfig`; its fields are options too.
        connection: How to reach other nodes.
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.
        overwrite: Replace an existing recording.

    Returns:
        Path of the recording, and the errors and the power over its last window.

    Raises:
        SafetyStop: If the fin was stopped.
    """
    from softfin.rig.ros2.plant import open_transport

    defaults = NodeConfig() if fin is None else NodeConfig.of_fin(fin)
    topics = configure(
        defaults,
        config,
        connection=typed_fields(connection),
        feedback={} if feedback else None,
    )
    drive = Drive.prepare(
        controller, plant, Arming(arm, yes), seconds, bag, topics.feedback, overwrite
    )
    # Opened before the machine so that problems with ROS 2 appear before anything moves.
    transport = open_transport(topics.connection)
    try:
        driven = NodeDrive.connect(drive, transport, topics, reference, strict)
        line = f"references come from the topic; {STOP_KEY}"
        return driven.run(StopRequest(), lambda _: say(line))
    finally:
        transport.close()


def typed_fields(connection: TransportConfig | None) -> JsonObject | None:
    """Return the fields of a connection that were set; None if no field was set."""
    return None if connection is None else connection.model_dump(exclude_unset=True)
