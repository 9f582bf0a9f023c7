"""Commands that let a controller drive a real fin: ``run`` with live references, ``ros2`` as a
node; no JAX."""

import contextlib
import functools
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from softfin.cli.common import (
    Armed,
    Common,
    ControllerFolder,
    File,
    ForcePair,
    LivePlant,
    NodeOptions,
    ReferenceFile,
    on_terminal,
)
from softfin.control.controller import LoadedController
from softfin.control.disturbance_observer import DisturbanceObserver
from softfin.control.references import resolve_reference
from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.core.quantities import RATE_HZ
from softfin.gaits.reachable import force_decimals
from softfin.rig.loop import (
    ActionResult,
    LiveReference,
    ReferenceSource,
    recorded_reference,
    run_controller,
)
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import Guard
from softfin.rig.session import Observer, Session, mean_force
from softfin.rig.stop import StopRequest, listen_to_keyboard
from softfin.stages.machines import find_robot
from softfin.storage import artifact as artifacts


class Driving(Armed, Common):
    """Options of every command that lets a controller drive a real fin."""

    controller: ControllerFolder
    """Controller folder."""
    plant: LivePlant = "rig"
    """The fin: rig or ros2, optionally followed by :FILE."""
    seconds: int | None = None
    """Duration [s] (default: until you stop it)."""
    bag: File | None = None
    """Recording to write, a ROS 2 bag (default: run-DATE.mcap)."""
    strict: bool = False
    """Reject unreachable references instead of tracking the nearest reachable one."""
    trim: bool = False
    """Add force feedback, which removes the steady-state error of the measured mean force."""

    def check(self) -> None:
        """Reject unusable options, such as an existing recording, before anything moves."""
        if self.seconds is not None and self.seconds < 1:
            raise ConfigurationError(
                f"--seconds {self.seconds}: must be at least 1; omit it to run until you stop it"
            )
        if self.bag is not None:
            if self.bag.suffix != ".mcap":
                raise ConfigurationError(f"--bag {self.bag}: must end in .mcap")
            artifacts.check_file(self.bag, self.overwrite, "--bag")
        super().check()

    def parties(self) -> tuple[LoadedController, RobotSetup]:
        """Load the controller and the machine and check that they match; nothing is opened yet."""
        controller = load_controller(self.controller)
        robot = find_robot(self.plant)
        robot.check_fits(str(self.controller), controller.limits, controller.artifact.fin)
        return controller, robot

    def drive(
        self,
        controller: LoadedController,
        robot: RobotSetup,
        references: ReferenceSource,
        seconds: int | None,
        line: Callable[[str], None],
        stop: StopRequest | None = None,
        observers: Sequence[Observer] = (),
    ) -> JsonObject:
        """Ask for confirmation, then move and record.

        `line` is called with each line typed in the meantime. Returns the path of the recording and
        the errors over its last window.
        """
        bag = self.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
        guard = Guard(robot.safety, robot.machine.limits, controller.artifact.training_range)
        stop = stop or StopRequest()
        acting: LoadedController | DisturbanceObserver = (
            DisturbanceObserver(controller) if self.trim else controller
        )
        with Session(robot.machine, guard, stop=stop, observers=observers, warn=say) as session:
            self.confirm(robot)
            if not any(controller.artifact.training_range or ()):
                say(
                    f"{self.controller}: no training range stored, so softfin cannot detect when "
                    "the fin leaves it"
                )
            listen_on_terminal(stop, line)
            # Only now, after the confirmation, is an existing recording replaced.
            bag.unlink(missing_ok=True)
            session.stop_on_signals()
            with session.recording(bag):
                session.activate()
                zero = session.rest(robot.settle_s)
                summary = _follow(session, acting, references, zero, seconds)
                session.deactivate()
        return {
            "bag": str(bag),
            **summary,
            "clock": session.pace.to_dict(),
            "counters": robot.machine.counters(),
        }

    def tell_errors(self, result: JsonObject) -> None:
        """Print the path of the recording and the errors over its last window."""
        errors = f"({result['error_x_n']}, {result['error_y_n']})"
        self.tell(
            result,
            f"{result['bag']}: {result['seconds']:.1f} s, error over the last "
            f"{result['window_s']:g} s {errors} N",
        )


def listen_on_terminal(stop: StopRequest, line: Callable[[str], None]) -> None:
    """Request a stop on Enter or when the terminal's input ends; call `line` with any other
    input."""
    if on_terminal() and not _in_background():
        listen_to_keyboard(stop, line, typed(stop, sys.stdin))


def _in_background() -> bool:
    """Whether this is a background job (&): reading would suspend it, in the middle of a motion."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp()
    except OSError:
        # A terminal that does not control this session has no job control.
        return False


def typed(stop: StopRequest, terminal: Iterable[str]) -> Iterator[str]:
    """Yield the lines typed on the terminal. If they end or are not text, request an emergency
    stop, because no key can stop the fin any more."""
    with contextlib.suppress(OSError, ValueError):
        yield from terminal
    stop.ask(
        "emergency_stop", "the terminal's input ended or is not text, so no key could stop the fin"
    )


class KeyboardStop:
    """Stops a stage when the operator presses Enter, once the motion is confirmed."""

    def __init__(self, confirm: Callable[[RobotSetup], None]) -> None:
        self.stop = StopRequest()
        """Stop request that Enter triggers."""
        self._confirm = confirm

    def confirm(self, robot: RobotSetup) -> None:
        """Ask whether the fin may move, then listen for Enter; raises ConfigurationError if it may
        not."""
        self._confirm(robot)
        listen_on_terminal(
            self.stop, lambda _: say("the commands are fixed; press Enter alone to stop the fin")
        )


def say(text: str) -> None:
    """Print a line on the terminal."""
    sys.stderr.write(printable(text) + "\n")


def _follow(
    session: Session,
    controller: LoadedController | DisturbanceObserver,
    references: ReferenceSource,
    zero: ForcePair,
    seconds: int | None,
) -> JsonObject:
    """Run the controller and print one line per second; returns the errors over the last window."""
    reachable = controller.reachable
    decimals = 2 if reachable is None else force_decimals(reachable.reach_n)
    window: list[ActionResult] = []
    ticks = printed = 0
    clock = controller.clock
    actions = None if seconds is None else clock.actions_within(seconds * RATE_HZ)
    for result in run_controller(session, controller, references, actions, zero):
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
                f"{ticks / RATE_HZ:7.1f} s  reference ({reference}) N  "
                f"mean over {clock.window_ticks / RATE_HZ:g} s ({mean}) N  "
                f"angle {result.samples[-1].angle:+.2f} rad"
            )
            try:
                say(line)
            except OSError as error:
                # The terminal was closed, or the program that reads the output has exited.
                session.stop_request.ask(
                    "emergency_stop", f"nobody reads the output any more ({error.strerror})"
                )
    errors = [abs(mean - asked) for mean, asked in zip((x, y), window[-1].reference, strict=True)]
    return {
        "seconds": ticks / RATE_HZ,
        "window_s": clock.window_ticks / RATE_HZ,
        "error_x_n": round(errors[0], 4),
        "error_y_n": round(errors[1], 4),
    }


class RunArguments(Driving):
    """Hold reference forces on the real fin. While it runs, type X,Y and Enter for a new reference,
    or Enter alone to stop."""

    reference: ForcePair | None = None
    """First reference force [N], such as --reference=1,-0.5."""
    reference_file: ReferenceFile | None = None
    """Recorded reference to use instead: .csv or .parquet with the columns time_s, force_x_n,
    force_y_n. Each row holds until the next one."""

    def check(self) -> None:
        """Reject two references, or none."""
        if (self.reference is None) == (self.reference_file is None):
            raise ConfigurationError("use either --reference=X,Y or --reference-file FILE")
        super().check()

    def __call__(self) -> None:
        controller, robot = self.parties()

        def resolve(force: tuple[float, float]) -> tuple[tuple[float, float], str | None]:
            return resolve_reference(controller, force, self.strict)

        if self.reference is not None:
            live = LiveReference(self.reference, resolve, say)
            result = self.drive(controller, robot, live, self.seconds, live.set_from_text)
        elif self.reference_file is not None:
            # Imported here, because reading the file needs packages that a robot may lack.
            from softfin.task.signals import read_reference_file

            rows = read_reference_file(self.reference_file)
            recorded = recorded_reference(
                rows.time_s, [(float(x), float(y)) for x, y in rows.force_n], resolve, say
            )
            line = "references come from the file; press Enter alone to stop the fin"
            result = self.drive(
                controller, robot, recorded, self.seconds or rows.seconds, lambda _: say(line)
            )
        self.tell_errors(result)


class Ros2Arguments(NodeOptions, Driving):
    """Run as a ROS 2 node: hold the reference force from a topic on the real fin, and publish every
    sample. Enter or a topic stops the fin.

    To change topics, frames and timeouts, use --set, e.g. --set joint_topic=/NAME; see
    docs/ros2.md.
    """

    reference: ForcePair
    """Reference force [N] while the topic has no recent message, such as --reference=1,-0.5."""
    fin: str | None = None
    """Name of one fin of a robot. Its topics are /NAME/joint_states, /NAME/reference and so on. It
    stops when references stop arriving."""

    def __call__(self) -> None:
        from softfin.rig.machine import machine_clock
        from softfin.rig.ros2.config import NodeConfig
        from softfin.rig.ros2.node import RosNode, default_reference_limit
        from softfin.rig.ros2.plant import Ros2Machine, open_transport

        defaults = NodeConfig() if self.fin is None else NodeConfig.of_fin(self.fin)
        topics = self.configured(defaults, connection=self.connection)
        controller, robot = self.parties()
        if machine_clock(robot.machine).is_simulated:
            raise RigError(
                f"{robot.machine.name}: emulated in simulated time, which does not work with "
                "topics; start softfin rig emulate --real-time"
            )
        if isinstance(robot.machine, Ros2Machine):
            robot.machine.config.check_apart(topics)
        otherwise, warning = resolve_reference(controller, self.reference, self.strict)
        # Opened before the machine, so that problems with ROS 2 appear before anything moves.
        transport = open_transport(topics.connection)
        try:
            node = RosNode(
                transport,
                topics,
                say,
                lambda asked: resolve_reference(controller, asked, self.strict),
                default_limit_n=default_reference_limit(controller),
            )
            for note in (*transport.notes, *([] if warning is None else [warning])):
                say(note)
            stop = StopRequest()
            result = self.drive(
                controller,
                robot,
                lambda _: node.reference() or otherwise,
                self.seconds,
                lambda _: say("references come from the topic; press Enter alone to stop the fin"),
                stop,
                (functools.partial(node.observe, stop),),
            )
            result["counters"] |= node.counters()
        finally:
            transport.close()
        self.tell_errors(result)
