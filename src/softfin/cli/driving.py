"""What ``softfin run`` and ``softfin ros2`` share: a controller's folder on a real fin, told once a second; no JAX."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from softfin.cli.live import Driving, on_terminal
from softfin.control.controller import LoadedController
from softfin.control.disturbance_observer import DisturbanceObserver
from softfin.control.store import load_controller
from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.errors import RigError
from softfin.core.printable import printable
from softfin.core.quantities import RATE_HZ
from softfin.rig.loop import (
    ActionResult,
    RealTimeController,
    References,
    mean_force,
    run_controller,
    seconds_to_actions,
)
from softfin.rig.machine import clock_of
from softfin.rig.robot_setup import RobotSetup, find_robot
from softfin.rig.safety import Guard
from softfin.rig.session import Observer, Session
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.stop import StopRequest, listen_to_keyboard

LINE_S = 1.0
"""Between two lines of what goes on."""


def parties(options: Driving) -> tuple[LoadedController, RobotSetup]:
    """Load the controller and the machine, which must fit each other; nothing is opened yet."""
    controller = load_controller(options.controller)
    robot = find_robot(options.plant)
    robot.check_fits(str(options.controller), controller.limits, controller.artifact.fin)
    return controller, robot


def check_real_time(robot: RobotSetup) -> None:
    """Raise RigError where its time is simulated: nobody outside this process lives in that."""
    if isinstance(clock_of(robot.machine), SimulatedClock):
        raise RigError(
            f"{robot.machine.name}: emulated in simulated time, in which no topic can be heard; start "
            "softfin rig emulate --real-time"
        )


def drive(
    options: Driving,
    controller: LoadedController,
    robot: RobotSetup,
    references: References,
    seconds: int | None,
    *,
    stop: StopRequest,
    observers: Sequence[Observer] = (),
    line: Callable[[str], None],
) -> dict[str, Any]:
    """Ask, move, record; `line` gets what is typed meanwhile. Where the recording is, and how well it went."""
    bag = options.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
    guard = Guard(robot.safety, robot.machine.limits, controller.artifact.training_range)
    acting: RealTimeController = DisturbanceObserver(controller) if options.trim else controller
    with Session(robot.machine, guard, stop=stop, observers=observers) as session:
        options.confirm(robot)
        if not any(controller.artifact.training_range or ()):
            say(f"{options.controller}: says nothing of its surrogate's data; nobody sees whether the fin leaves them")
        if on_terminal():
            listen_to_keyboard(stop, line, typed(stop, sys.stdin))
        bag.unlink(missing_ok=True)
        session.stop_on_signals()
        with session.recording(bag):
            session.activate()
            session.rest(robot.settle_s)
            summary = _follow(session, acting, references, seconds)
            session.deactivate()
    return {"bag": str(bag), **summary, "clock": session.pace.to_dict(), "counters": robot.machine.counters()}


def sentence(result: dict[str, Any]) -> str:
    """What `drive` gave, for people."""
    return (
        f"{result['bag']}: {result['seconds']:.1f} s, error over the last 2 s ({result['error_x_n']}, "
        f"{result['error_y_n']}) N"
    )


def typed(stop: StopRequest, terminal: Iterable[str]) -> Iterator[str]:
    """Lines of the terminal; where they end, as at Ctrl-D, nobody can stop the fin by a key any more, so it stops."""
    yield from terminal
    stop.ask("emergency_stop", "the terminal's input ended, so no key could stop the fin")


def say(text: str) -> None:
    """A line for whoever stands by."""
    sys.stderr.write(printable(text) + "\n")


def _follow(
    session: Session, controller: RealTimeController, references: References, seconds: int | None
) -> dict[str, Any]:
    """Run it, tell once a second how it goes; the errors of the last window."""
    window: list[ActionResult] = []
    ticks, told = 0, 0.0
    actions = None if seconds is None else seconds_to_actions(seconds)
    for result in run_controller(session, controller, references, actions):
        window = [*window[-CYCLE_ACTIONS + 1 :], result]
        ticks += len(result.samples)
        if ticks / RATE_HZ - told >= LINE_S:
            told = ticks / RATE_HZ
            x, y = mean_force([sample for each in window for sample in each.samples])
            line = (f"{told:7.1f} s  reference ({result.reference[0]:+.2f}, {result.reference[1]:+.2f}) N  "
                    f"mean over 2 s ({x:+.3f}, {y:+.3f}) N  angle {result.samples[-1].angle:+.2f} rad")  # fmt: skip
            try:
                say(line)
            except OSError as error:
                # The terminal was closed, or what the lines are piped into has ended: nobody stands by any more.
                session.stop_request.ask("emergency_stop", f"nobody reads its lines any more ({error.strerror})")
    force = mean_force([sample for each in window for sample in each.samples])
    errors = [abs(mean - asked) for mean, asked in zip(force, window[-1].reference, strict=True)]
    return {"seconds": ticks / RATE_HZ, "error_x_n": round(errors[0], 4), "error_y_n": round(errors[1], 4)}
