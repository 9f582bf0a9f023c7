"""Commands that let a controller drive a real fin, ``softfin run`` and ``softfin ros2``, share this; no JAX."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softfin.cli.common import Armed, Common, on_terminal
from softfin.cli.kinds import Controller, File, LivePlant
from softfin.control.native import NativeController, load_native, trimmed
from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable
from softfin.core.quantities import RATE_HZ
from softfin.rig.bench import Bench, check_fits
from softfin.rig.find import find_bench
from softfin.rig.loop import Held, References, hold, seconds_to_actions
from softfin.rig.reach import knows_its_range
from softfin.rig.recording import recording
from softfin.rig.safety import Guard
from softfin.rig.session import Observer, Session
from softfin.rig.stop import Keyboard, StopRequest, stopped_by_signals


@dataclass(frozen=True, kw_only=True)
class Driving(Armed, Common):
    """Options of every command that lets a controller drive a real fin."""

    controller: Controller
    """Folder of the controller."""
    plant: LivePlant = "rig"
    """The fin: rig (rig.yaml), ros2, or one of these with :FILE."""
    seconds: int | None = None
    """Duration [s]; without it until you stop it."""
    bag: File | None = None
    """The recording, a ROS 2 bag, NAME.mcap (run-DATE.mcap)."""
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is held, with a warning."""
    trim: bool = False
    """Add a slow outer loop that cancels the steady-state force error, from the measured mean force."""

    def check(self) -> None:
        """Refuse a recording that would replace another one, before anything moves."""
        if self.seconds is not None and self.seconds < 1:
            raise ConfigurationError(f"--seconds {self.seconds}: at least 1; leave it out to run until you stop it")
        if self.bag is not None:
            if self.bag.suffix != ".mcap":
                raise ConfigurationError(f"--bag {self.bag}: a recording is a file NAME.mcap")
            if self.bag.is_dir() or (self.bag.exists() and not self.overwrite):
                raise ConfigurationError(
                    f"--bag {self.bag}: exists already; give another one, or --overwrite to replace it"
                )
        super().check()

    def parties(self) -> tuple[NativeController, Bench]:
        """Load the controller and the machine, which must fit each other; nothing is opened yet."""
        controller, bench = load_native(self.controller), find_bench(self.plant)
        check_fits(str(self.controller), controller.limits, controller.fin, bench)
        return controller, bench

    def drive(
        self,
        controller: NativeController,
        bench: Bench,
        references: References,
        seconds: int | None,
        line: Callable[[str], None],
        stop: StopRequest | None = None,
        observers: Sequence[Observer] = (),
    ) -> dict[str, Any]:
        """Ask, move, record; `line` gets what is typed meanwhile. Returns the recording and the errors at its end."""
        bag = self.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
        guard, stop = Guard(bench.safety, bench.machine.limits, controller.training_range), stop or StopRequest()
        acting = trimmed(controller) if self.trim else controller
        with Session(bench.machine, guard, stop=stop, observers=observers) as session:
            self.confirm(bench)
            if not knows_its_range(controller.training_range):
                say(f"{self.controller}: holds no range of its surrogate's data, so leaving that range is not noticed")
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

    def tell_errors(self, result: dict[str, Any]) -> None:
        """Print the recording and the errors at its end."""
        errors = f"({result['error_x_n']}, {result['error_y_n']})"
        self.tell(result, f"{result['bag']}: {result['seconds']:.1f} s, error over the last 2 s {errors} N")


def typed(stop: StopRequest, terminal: Iterable[str]) -> Iterator[str]:
    """Lines of the terminal; where they end, as at Ctrl-D, nobody can stop the fin by a key any more, so it stops."""
    yield from terminal
    stop.ask("emergency_stop", "the terminal's input ended, so no key could stop the fin")


def say(text: str) -> None:
    """Print a line for the person at the terminal."""
    sys.stderr.write(printable(text) + "\n")


def _follow(
    session: Session, controller: NativeController, references: References, seconds: int | None
) -> dict[str, Any]:
    """Run the controller and print a line every second; returns the errors of the last window."""
    window: list[Held] = []
    ticks = printed = 0
    for held in hold(session, controller, references, None if seconds is None else seconds_to_actions(seconds)):
        window = [*window[-CYCLE_ACTIONS + 1 :], held]
        ticks += len(held.samples)
        if ticks - printed >= RATE_HZ:
            printed = ticks
            x, y = _mean(window)
            line = (f"{ticks / RATE_HZ:7.1f} s  reference ({held.reference[0]:+.2f}, {held.reference[1]:+.2f}) N  "
                    f"mean over 2 s ({x:+.3f}, {y:+.3f}) N  angle {held.samples[-1].angle:+.2f} rad")  # fmt: skip
            try:
                say(line)
            except OSError as error:
                # The terminal was closed, or what the lines are piped into has ended: nobody reads them any more.
                session.stop_request.ask("emergency_stop", f"nobody reads its lines any more ({error.strerror})")
    errors = [abs(force - asked) for force, asked in zip(_mean(window), window[-1].reference, strict=True)]
    return {"seconds": ticks / RATE_HZ, "error_x_n": round(errors[0], 4), "error_y_n": round(errors[1], 4)}


def _mean(window: list[Held]) -> tuple[float, float]:
    wrenches = [sample.wrench for held in window for sample in held.samples]
    return sum(w[0] for w in wrenches) / len(wrenches), sum(w[1] for w in wrenches) / len(wrenches)
