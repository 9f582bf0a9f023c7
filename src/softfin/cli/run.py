"""``softfin run``: a controller on the real fin, references live; no JAX, and nothing of it is needed."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from softfin.action_clock import CYCLE_ACTIONS
from softfin.cli.common import Common, force
from softfin.cli.live import Armed
from softfin.deployment.bench import check_fits
from softfin.deployment.loop import Held, References, hold, seconds_to_actions
from softfin.deployment.native import NativeController, load_native, trimmed
from softfin.deployment.recording import recording
from softfin.deployment.references import Recorded, Said
from softfin.deployment.safety import Guard
from softfin.deployment.session import Session
from softfin.deployment.stop import Keyboard, StopRequest, stopped_by_signals
from softfin.errors import ConfigurationError
from softfin.live import is_live
from softfin.rig.find import find_bench

LINE_S = 1.0
"""Between two lines of what goes on."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Armed, Common):
    """Hold reference forces on the real fin; while it runs, type X,Y and Enter for another one, Enter alone to stop."""

    controller: tyro.conf.Positional[Path]
    """Folder of the controller."""
    plant: str = "rig"
    """The fin: rig (rig.yaml), ros2, or one of these with :FILE."""
    reference: str | None = None
    """Reference force as --reference=X,Y in newton, at first."""
    reference_file: Path | None = None
    """One that moves, instead: .csv or .parquet with time_s, force_x_n, force_y_n, each row held until the next one."""
    seconds: int | None = None
    """How long; without it until you stop it, or the file ends."""
    bag: Path | None = None
    """The recording, a ROS 2 bag (run-DATE.mcap)."""
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is held, with a warning."""
    trim: bool = False
    """Take off, slowly, what the fin makes besides what it is asked for, from the measured mean force."""

    def run(self) -> None:
        """Run."""
        if not is_live(self.plant):
            raise ConfigurationError(f"--plant {self.plant}: is simulated; softfin evaluate judges a controller there")
        if (self.reference is None) == (self.reference_file is None):
            raise ConfigurationError("give --reference=X,Y or --reference-file, one of them")
        controller = load_native(self.controller)
        bench = find_bench(self.plant)
        check_fits(str(self.controller), controller.limits, controller.fin, bench)
        references, seconds = self._references(controller)
        acting = trimmed(controller) if self.trim else controller
        bag = self.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
        request = StopRequest()
        guard = Guard(bench.safety, bench.machine.limits, controller.training_range)
        with Session(bench.machine, guard, stop=request) as session:
            self.confirm(bench)
            if isinstance(references, Said) and sys.stdin.isatty():
                Keyboard(request, references.line).start()
            with stopped_by_signals(request), recording(session, bag):
                session.activate()
                session.rest(bench.settle_s)
                summary = follow(session, acting, references, seconds, _say)
                session.deactivate()
            counters = bench.machine.counters()
            clock = session.pace.described()
        result = {"bag": str(bag), **summary, "clock": clock, "counters": counters}
        self.tell(result, f"{bag}: {summary['seconds']:.1f} s, error over the last 2 s "
                  f"({summary['error_x_n']}, {summary['error_y_n']}) N")  # fmt: skip

    def _references(self, controller: NativeController) -> tuple[References, int | None]:
        def admit(force: tuple[float, float]) -> tuple[tuple[float, float], str | None]:
            return controller.admit(force, self.strict)

        if self.reference_file is not None:
            # Imported here: it needs more than a robot's computer may have.
            from softfin.tracking.reference_file import read_reference_file

            recorded = read_reference_file(self.reference_file)
            forces = [(float(x), float(y)) for x, y in recorded.force_n]
            return Recorded(recorded.time_s, forces, admit, _say), self.seconds or recorded.seconds
        return Said(force(str(self.reference)), admit, _say), self.seconds


def follow(
    session: Session, controller: Any, references: References, seconds: int | None, say: Callable[[str], None]
) -> dict[str, Any]:
    """Run it, tell once a second how it goes; the errors of the last window."""
    window: list[Held] = []
    ticks, told = 0, 0.0
    for held in hold(session, controller, references, None if seconds is None else seconds_to_actions(seconds)):
        window = [*window[1 - CYCLE_ACTIONS :], held]
        ticks += len(held.samples)
        if ticks / 100 - told >= LINE_S:
            told = ticks / 100
            x, y = mean_of(window)
            say(f"{told:7.1f} s  reference ({held.reference[0]:+.2f}, {held.reference[1]:+.2f}) N  "
                f"mean over 2 s ({x:+.3f}, {y:+.3f}) N  angle {held.samples[-1].angle:+.2f} rad")  # fmt: skip
    errors = [abs(made - asked) for made, asked in zip(mean_of(window), window[-1].reference, strict=True)]
    return {"seconds": ticks / 100, "error_x_n": round(errors[0], 4), "error_y_n": round(errors[1], 4)}


def mean_of(window: list[Held]) -> tuple[float, float]:
    """The mean force of some actions [N]."""
    wrenches = [sample.wrench for held in window for sample in held.samples]
    return sum(w[0] for w in wrenches) / len(wrenches), sum(w[1] for w in wrenches) / len(wrenches)


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
