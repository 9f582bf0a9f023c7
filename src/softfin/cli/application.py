"""Turns a function into a command: its parameters are the options, its docstring is the help.

If the function has a parameter `config`, an option that is not a parameter is a field of its
configuration, such as ``--excitation.hold-min-s 0.2``.
"""

import difflib
import inspect
import io
import re
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from cyclopts import App, CycloptsError, Parameter
from cyclopts.help import DefaultFormatter, PanelSpec, TableSpec
from pydantic import ValidationError
from rich import box
from rich.console import Console

from softfin.core.configuration import Changes, option_name, read_yaml
from softfin.core.errors import ConfigurationError

CONFIG = "config"
"""Name of the parameter that any field of a configuration changes."""

EPILOGUE = (
    "--json prints the result as JSON, --debug shows the traceback of an error, -h or --help this "
    "help."
)


def make_app(function: Callable[..., object], program: str = "softfin") -> App:
    """Return the application that parses the arguments of a function."""
    app = App(
        name=program,
        help_formatter=DefaultFormatter(
            panel_spec=PanelSpec(box=box.SIMPLE, padding=(0, 0)),
            table_spec=TableSpec(padding=(0, 2, 0, 0)),
        ),
        help_epilogue=EPILOGUE,
        help_flags=(),
        version_flags=(),
        default_parameter=Parameter(
            negative=(),
            name_transform=option_name,
            show_default=_show_default,
            # The last value counts, so that a script may append options.
            allow_repeating=True,
        ),
    )
    app.default(function)
    return app


def _show_default(default: object) -> str | None:
    if isinstance(default, bool) or default in (None, (), {}):
        return None
    values = default if isinstance(default, tuple) else (default,)
    return " ".join(map(str, values))


def list_options(function: Callable[..., object]) -> tuple[str, ...]:
    """Return the names of a function's options and positional arguments."""
    arguments = make_app(function).assemble_argument_collection()
    return tuple(name for argument in arguments if argument.show for name in argument.names)


def format_help(function: Callable[..., object], program: str, width: int | None = None) -> str:
    """Return the help of a command, as wide as the terminal."""
    console = Console(file=io.StringIO(), width=width or shutil.get_terminal_size().columns)
    with console.capture() as capture:
        make_app(function, program).help_print([], console=console)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def parse(function: Callable[..., object], words: Sequence[str]) -> "partial[object]":
    """Return a call of the function with the arguments that were typed; raises ConfigurationError
    with a one-line message."""
    options = list_options(function)
    changes: dict[str, str] = {}
    if CONFIG in inspect.signature(function).parameters:
        words, changes = _split(words, options)
    try:
        _, bound, _ = make_app(function).parse_args(
            _join_negative(words), exit_on_error=False, print_error=False
        )
    except CycloptsError as error:
        raise ConfigurationError(_explain(error)) from None
    given = dict(bound.kwargs)
    if changes or CONFIG in given:
        file = None
        if CONFIG in given:
            file = Path(given[CONFIG])
            # Reported now, because the function first imports what it configures.
            read_yaml(file)
        given[CONFIG] = Changes(file, changes, options)
    return partial(function, *bound.args, **given)


def _join_negative(words: Sequence[str]) -> list[str]:
    """Join an option with a value such as -1,2, which is not an option."""
    joined: list[str] = []
    for word in words:
        if re.match(r"-[\d.]", word) and joined and joined[-1].startswith("--"):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _split(words: Sequence[str], options: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return the words without the fields of the configuration, and the texts of these fields."""
    rest: list[str] = []
    changes: dict[str, str] = {}
    left = list(words)
    while left:
        word = left.pop(0)
        written, sign, text = word.partition("=")
        option = written.replace("_", "-")
        if not word.startswith("--") or option in options:
            rest.append(word)
        elif sign:
            changes[option] = text
        elif left and not left[0].startswith("--"):
            changes[option] = left.pop(0)
        else:
            close = difflib.get_close_matches(option, options, n=1)
            nearest = f"; did you mean {close[0]}?" if close else ""
            raise ConfigurationError(f"{option}: unknown option, or missing value{nearest}")
    return rest, changes


def _explain(error: CycloptsError) -> str:
    """Return one line that describes an error."""
    if isinstance(error.__cause__, ValidationError):
        first = error.__cause__.errors()[0]
        field = option_name(".".join(map(str, first["loc"])))
        return f"--{field} {first['input']}: {first['msg'].removeprefix('Value error, ')}"
    error.verbose = False
    return " ".join(str(error).split())
