"""What commands share: configuration from a file and ``--set``; progress on stderr, results on stdout."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from softfin.cli import options
from softfin.cli.kinds import YamlFile
from softfin.cli.options import Option
from softfin.core.choices import SEEDS
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable
from softfin.storage import artifact as artifacts

if TYPE_CHECKING:
    from rich.progress import TaskID

    from softfin.core.configuration import Configuration

Config = TypeVar("Config", bound="Configuration")

Report = Callable[[str, float, str], None]
"""`softfin.core.progress.Progress`; that module needs JAX, which not every command does."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Options of every command."""

    json: bool = False
    """Print the result as JSON on standard output."""
    debug: bool = False
    """Show the traceback of an error."""

    def check(self) -> None:
        """Raise a SoftfinError where what is asked cannot be: before anything is computed, or imported for it."""
        seed = getattr(self, "seed", None)
        if seed is not None and not 0 <= seed < SEEDS:
            raise ConfigurationError(f"--seed {seed}: a seed is a whole number from 0 to {SEEDS - 1}")
        options.check(self)

    def tell(self, result: Any, text: str) -> None:
        """The result: as JSON, or as text for people."""
        sys.stdout.write(artifacts.dump_json(result) if self.json else printable(text.rstrip("\n"), "\n") + "\n")


@dataclass(frozen=True, kw_only=True)
class Common(Command):
    """Options of every command that writes."""

    overwrite: bool = False
    """Replace what is there already, and drop an unfinished run of it."""


@dataclass(frozen=True, kw_only=True)
class Configured(Common):
    """Options of every command that has a configuration."""

    config: YamlFile | None = None
    """YAML file that changes the configuration."""
    set: Annotated[tuple[str, ...], Option("PATH=VALUE")] = ()
    """Change one value of the configuration."""

    def configured(self, base: Config, **options: Any) -> Config:
        """The defaults, changed by the YAML file, then by `--set`, then by the options that were given."""
        from softfin.core.configuration import read_yaml

        config = base if self.config is None else base.merged(read_yaml(self.config), str(self.config))
        given = {name: value for name, value in options.items() if value is not None}
        return config.changed(self.set).merged(given, "options")


@contextmanager
def progress() -> Iterator[Report]:
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
        self.every_s = every_s
        self._next = 0.0
        self._stage = ""

    def __call__(self, stage: str, done: float, note: str) -> None:
        now = time.monotonic()
        if stage != self._stage or now >= self._next or done >= 1:
            sys.stderr.write(f"{stage}: {done:.0%} {printable(note)}\n")
            self._stage, self._next = stage, now + self.every_s
