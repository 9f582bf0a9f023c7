"""Options that commands share: configuration, arming; running a stage with progress on stderr, results on stdout."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar

from softfin.cli import options
from softfin.cli.kinds import YamlFile
from softfin.cli.options import Option
from softfin.core.choices import SEEDS
from softfin.core.configuration import Configuration, read_yaml
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable
from softfin.data.importing.importing import ImportConfig
from softfin.storage import artifact as artifacts

if TYPE_CHECKING:
    from rich.progress import TaskID

    from softfin.rig.robot_setup import RobotSetup

Config = TypeVar("Config", bound=Configuration)
Result = TypeVar("Result")

WORD = "move"
"""Word that a person types to let the fin move."""


@dataclass(frozen=True, kw_only=True)
class CommandOptions:
    """Options of every command."""

    json: bool = False
    """Print the result as JSON on standard output."""
    debug: bool = False
    """Show the traceback of an error."""

    def check(self) -> None:
        """Raise a SoftfinError where the options cannot be used, before anything is computed or imported for it."""
        seed = getattr(self, "seed", None)
        if seed is not None and not 0 <= seed < SEEDS:
            raise ConfigurationError(f"--seed {seed}: a seed is a whole number from 0 to {SEEDS - 1}")
        options.check(self)

    def tell(self, result: Any, text: str) -> None:
        """Print the result: as JSON, or as text for people."""
        sys.stdout.write(artifacts.dump_json(result) if self.json else printable(text.rstrip("\n"), "\n") + "\n")


@dataclass(frozen=True, kw_only=True)
class Common(CommandOptions):
    """Options of every command that writes."""

    overwrite: bool = False
    """Replace what is there already, and drop an unfinished run of it."""

    def stage(self, stage: Callable[..., Result], *arguments: Any, **given: Any) -> Result:
        """Run a stage and show its progress."""
        with progress() as report:
            return stage(*arguments, **given, overwrite=self.overwrite, progress=report)


@dataclass(frozen=True, kw_only=True)
class Configured(Common):
    """Options of every command that has a configuration."""

    config: YamlFile | None = None
    """YAML file that changes the configuration."""
    set: Annotated[tuple[str, ...], Option("PATH=VALUE")] = ()
    """Change one value of the configuration."""

    def configured(self, base: Config, **given: Any) -> Config:
        """Return the defaults, changed by the YAML file, then by `--set`, then by the options that were given.

        These are the options that are None or () by default and have the name of a field; those that the command reads
        itself from a text or under another name are `given`.
        """
        config = base if self.config is None else base.merged(read_yaml(self.config), str(self.config))
        own = {option.name: getattr(self, option.name) for option in fields(self)
               if option.name in type(base).model_fields and option.default in (None, ())}  # fmt: skip
        own = {name: value for name, value in own.items() if not isinstance(value, str)} | given
        changes = {name: value for name, value in own.items() if value not in (None, ())}
        return config.changed(self.set).merged(changes, "options")


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options of every command that reads recordings made by others; softfin's own need none of these."""

    recordings: ImportConfig = field(default_factory=ImportConfig)


def columns_read(columns: Mapping[str, str]) -> str:
    """Lines that tell how columns with names of their own were read, by the first log of each way; none where none."""
    return "".join(f"{log}: {text}\n" for log, text in columns.items())


def on_terminal() -> bool:
    """Whether a person may be there to answer; a program that was started without an input has none at all."""
    # Python leaves it out where the descriptor was closed, which its types do not tell.
    given: TextIO | None = sys.stdin
    return given is not None and given.isatty()


@dataclass(frozen=True, kw_only=True)
class Armed:
    """Options of every command that may move a real fin."""

    arm: bool = False
    """With --plant rig or ros2: the fin may move, once you confirm it on the terminal."""
    yes: bool = False
    """With --arm, do not ask: for scripts. Nobody stands by, so see that nobody can come near the fin."""

    def confirm(self, robot: "RobotSetup", motion: str | None = None) -> None:
        """Print the machine's notes; raise ConfigurationError unless a person confirms that it may move.

        `motion` is what it will do, if not to follow commands.
        """
        name = robot.machine.name
        for note in robot.machine.notes:
            sys.stderr.write(f"note: {printable(note)}\n")
        if not self.arm:
            told = "answers, and " if motion is None else ""
            raise ConfigurationError(f"{name}: {told}stays still: nothing moves without --arm")
        if self.yes:
            return
        if not on_terminal():
            raise ConfigurationError(f"{name}: --arm asks on a terminal whether it may move; in a script add --yes")
        limits = robot.machine.limits
        motion = motion or (
            f"the fin will move between {limits.angle_min:.2f} and {limits.angle_max:.2f} rad, at up to "
            f"{limits.velocity_max:.2f} rad/s"
        )
        sys.stderr.write(f"{printable(name)}: {motion}.\nCtrl-C stops it. Hands off? Type {WORD!r} and Enter: ")
        sys.stderr.flush()
        if sys.stdin.readline().strip() != WORD:
            raise ConfigurationError(f"{name}: not confirmed with {WORD!r}; nothing moved")


@contextmanager
def progress() -> Iterator[Callable[[str, float, str], None]]:
    """Show a bar on standard error, or a line every ten seconds where that is not a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines()
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Column

    # On a narrow terminal the bar gives way first, then the end of the note.
    bar, note = Column(min_width=4, ratio=1), Column(no_wrap=True, overflow="ellipsis")
    columns = (
        TextColumn("{task.description:>12}", markup=False, table_column=Column(no_wrap=True, min_width=12)),
        BarColumn(bar_width=None, table_column=bar), TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False, table_column=note),
    )  # fmt: skip
    with Progress(*columns, console=console, expand=True) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: float, note: str) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0, note="")
            bars.update(tasks[stage], completed=done, note=printable(note))

        yield report


class _Lines:
    """Progress for logs and pipes."""

    def __init__(self, every_s: float = 10.0) -> None:
        self.every_s, self._next, self._stage = every_s, 0.0, ""

    def __call__(self, stage: str, done: float, note: str) -> None:
        now = time.monotonic()
        if stage != self._stage or now >= self._next or done >= 1:
            sys.stderr.write(f"{stage}: {done:.0%} {printable(note)}\n")
            self._stage, self._next = stage, now + self.every_s
