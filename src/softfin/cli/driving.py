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
from softfin.rig.bench import Bench, check_fits
from softfin.rig.find import find_bench
from softfin.rig.loop import Acting, Held, References, hold, seconds_to_actions
from softfin.rig.machine import clock_of
from softfin.rig.reach import knows_its_range
from softfin.rig.recording import recording
from softfin.rig.safety import Guard
from softfin.rig.session import Observer, Session
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.stop import Keyboard, StopRequest, stopped_by_signals

LINE_S = 1.0
"""Between two lines of what goes on."""


def parties(options: Driving) -> tuple[LoadedController, Bench]:
    """The controller and the machine, which must fit each other; nothing is opened yet."""
    controller = load_controller(options.controller)
    bench = find_bench(options.plant)
    check_fits(str(options.controller), controller.limits, controller.artifact.fin, bench)
    return controller, bench


def check_real_time(bench: Bench) -> None:
    """Raise RigError where its time is simulated: nobody outside this process lives in that."""
    if isinstance(clock_of(bench.machine), SimulatedClock):
        raise RigError(
            f"{bench.machine.name}: emulated in simulated time, in which no topic can be heard; start "
            "softfin rig emulate --real-time"
        )


def drive(
    options: Driving,
    controller: LoadedController,
    bench: Bench,
    references: References,
    seconds: int | None,
    *,
    stop: StopRequest,
    observers: Sequence[Observer] = (),
    line: Callable[[str], None],
) -> dict[str, Any]:
    """Ask, move, record; `line` gets what is typed meanwhile. Where the recording is, and how well it went."""
    bag = options.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
    guard = Guard(bench.safety, bench.machine.limits, controller.artifact.training_range)
    acting: Acting = DisturbanceObserver(controller) if options.trim else controller
    with Session(bench.machine, guard, stop=stop, observers=observers) as session:
        options.confirm(bench)
        if not knows_its_range(controller.artifact.training_range):
            say(f"{options.controller}: says nothing of its surrogate's data; nobody sees whether the fin leaves them")
        if on_terminal():
            Keyboard(stop, line, typed(stop, sys.stdin)).start()
        bag.unlink(missing_ok=True)
        session.until_closed(stopped_by_signals(stop))
        with recording(session, bag):
            session.activate()
            session.rest(bench.settle_s)
            summary = _follow(session, acting, references, seconds)
            session.deactivate()
    return {"bag": str(bag), **summary, "clock": session.pace.described(), "counters": bench.machine.counters()}


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


def _follow(session: Session, controller: Acting, references: References, seconds: int | None) -> dict[str, Any]:
    """Run it, tell once a second how it goes; the errors of the last window."""
    window: list[Held] = []
    ticks, told = 0, 0.0
    for held in hold(session, controller, references, None if seconds is None else seconds_to_actions(seconds)):
        window = [*window[-CYCLE_ACTIONS + 1 :], held]
        ticks += len(held.samples)
        if ticks / RATE_HZ - told >= LINE_S:
            told = ticks / RATE_HZ
            x, y = _mean(window)
            line = (f"{told:7.1f} s  reference ({held.reference[0]:+.2f}, {held.reference[1]:+.2f}) N  "
                    f"mean over 2 s ({x:+.3f}, {y:+.3f}) N  angle {held.samples[-1].angle:+.2f} rad")  # fmt: skip
            try:
                say(line)
            except OSError as error:
                # The terminal was closed, or what the lines are piped into has ended: nobody stands by any more.
                session.stop_request.ask("emergency_stop", f"nobody reads its lines any more ({error.strerror})")
    errors = [abs(made - asked) for made, asked in zip(_mean(window), window[-1].reference, strict=True)]
    return {"seconds": ticks / RATE_HZ, "error_x_n": round(errors[0], 4), "error_y_n": round(errors[1], 4)}


def _mean(window: list[Held]) -> tuple[float, float]:
    wrenches = [sample.wrench for held in window for sample in held.samples]
    return sum(w[0] for w in wrenches) / len(wrenches), sum(w[1] for w in wrenches) / len(wrenches)
