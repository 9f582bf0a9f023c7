"""Turns a function into a command: its parameters are the options, its docstring is the help.

If the function has a parameter `config`, an option that is not a parameter is a field of its
configuration, such as ``--excitation.hold-min-s 0.2``.
"""

import difflib
import inspect
import io
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    UnusedCliTokensError,
)
from cyclopts.help import DefaultFormatter, PanelSpec, TableSpec
from pydantic import ValidationError
from rich import box
from rich.console import Console

from softfin.core.configuration import Changes, option_name, read_yaml, suggest_option
from softfin.core.errors import ConfigurationError

CONFIG = "config"
"""Name of the parameter that accepts any field of a configuration as an option."""

FLAG_SIMILARITY = 0.8
"""Minimum similarity of a misspelled flag to the flag, from 0 to 1. The fields of softfin's
configurations differ more from the flags of their commands."""

EPILOGUE = (
    "--json prints the result as JSON, --debug prints the traceback of an error, and -h or --help "
    "prints this help."
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
            # The last value is used, so that a script may append options.
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


def list_options(function: Callable[..., object], flags: bool = False) -> tuple[str, ...]:
    """Return the names of the options and positional arguments of a function, or only of its
    flags."""
    arguments = make_app(function).assemble_argument_collection()
    shown = [each for each in arguments if each.show and (each.hint is bool or not flags)]
    return tuple(name for argument in shown for name in argument.names)


def format_help(function: Callable[..., object], program: str, width: int | None = None) -> str:
    """Return the help of a command, as wide as the terminal."""
    console = Console(file=io.StringIO(), width=width or shutil.get_terminal_size().columns)
    with console.capture() as capture:
        make_app(function, program).help_print([], console=console)
    text = "\n".join(line.rstrip() for line in capture.get().splitlines())
    parameters = inspect.signature(function).parameters.values()
    positional = [each.name for each in parameters if each.kind is not each.KEYWORD_ONLY]
    return text.replace("[ARGS", f"[{positional[-1].upper()}", 1) if positional else text


def parse(
    function: Callable[..., object], words: Sequence[str], program: str = "softfin"
) -> "partial[object]":
    """Return a call of the function with the arguments that were typed; raises ConfigurationError
    with a one-line message."""
    options = list_options(function)
    flags = list_options(function, flags=True)
    changes: dict[str, str] = {}
    # After two hyphens, no word is an option.
    end = words.index("--") if "--" in words else len(words)
    rest = list(words[:end])
    if CONFIG in inspect.signature(function).parameters:
        rest, changes = _split(rest, options, flags)
    typed = [*_join_negative(rest, flags), *words[end:]]
    try:
        _, bound, _ = make_app(function).parse_args(typed, exit_on_error=False, print_error=False)
    except MissingArgumentError as error:
        usage = (
            format_help(function, program, width=1000).partition("\n")[0].replace("Usage", "usage")
        )
        raise ConfigurationError(_explain_missing(error, usage, options, changes)) from None
    except UnusedCliTokensError as error:
        raise ConfigurationError(_explain_unused(error, words, changes, function)) from None
    except CycloptsError as error:
        raise ConfigurationError(_explain(error)) from None
    given = dict(bound.kwargs)
    if changes or CONFIG in given:
        file = None
        if CONFIG in given:
            file = Path(given[CONFIG])
            # Report the error now, because the function first imports slow modules.
            read_yaml(file)
        given[CONFIG] = Changes(file, changes, options)
    return partial(function, *bound.args, **given)


def _join_negative(words: Sequence[str], flags: Sequence[str]) -> list[str]:
    """Join an option with a value such as -1,2 or -x,y, which is not an option."""
    joined: list[str] = []
    for word in words:
        before = joined[-1] if joined else ""
        takes_value = before.startswith("--") and "=" not in before and before not in flags
        if takes_value and re.match("-[^-]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _split(
    words: Sequence[str], options: Sequence[str], flags: Sequence[str]
) -> tuple[list[str], dict[str, str]]:
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
        elif (
            left
            and not left[0].startswith("--")
            # A misspelt flag has no value: the next word is an argument. Fields of fields have one.
            and (
                "." in option
                or not difflib.get_close_matches(option, flags, n=1, cutoff=FLAG_SIMILARITY)
            )
        ):
            changes[option] = left.pop(0)
        else:
            raise ConfigurationError(
                f"{option}: unknown option, or missing value; {suggest_option(option, options)}"
            )
    return rest, changes


def _explain_missing(
    error: MissingArgumentError, usage: str, options: Sequence[str], changes: Mapping[str, str]
) -> str:
    """Return one line that names a missing argument, option or value."""
    argument = error.argument
    if argument is None:
        return _explain(error)
    if error.keyword is not None:
        metavar = argument.parameter.metavar or "VALUE"
        return f"{error.keyword}: missing value; use {error.keyword} {metavar}"
    unknown = [word for word in error.unused_tokens or [] if word.startswith("--")]
    if unknown:
        return f"{unknown[0]}: unknown option; {suggest_option(unknown[0], options)}"
    name = argument.name
    if argument.field_info.kind is not inspect.Parameter.KEYWORD_ONLY:
        name = name.removeprefix("--").upper()
    # The missing value may have been parsed as the value of a misspelled option.
    values = "".join(f"; {text} is the value of {option}" for option, text in changes.items())
    return f"{name}: missing{values}; {usage}"


def _explain_unused(
    error: UnusedCliTokensError,
    words: Sequence[str],
    changes: Mapping[str, str],
    function: Callable[..., object],
) -> str:
    """Return one line that names the first superfluous word."""
    token = str(error.unused_tokens[0])  # type: ignore[index]
    place = words.index(token)
    option = words[place - 2] if place > 1 else ""
    if option not in changes:
        hint = "--help lists the arguments and options"
        parameters = [*inspect.signature(function).parameters.values()]
        # A command without positional arguments starts with the option for its input.
        if parameters and parameters[0].kind is inspect.Parameter.KEYWORD_ONLY:
            hint = f"did you mean --{option_name(parameters[0].name)} {token}? {hint}"
        return f"{token}: unexpected argument; {hint}"
    values = f"[{words[place - 1]}, {token}]"
    return f'{token}: unexpected argument; for several values, use {option} "{values}"'


def _explain(error: CycloptsError) -> str:
    """Return one line that describes an error."""
    if isinstance(error.__cause__, ValidationError):
        first = error.__cause__.errors()[0]
        # Within a field, the location is not part of the option.
        field = option_name(str(first["loc"][0]))
        return f"--{field} {first['input']}: {first['msg'].removeprefix('Value error, ')}"
    error.verbose = False
    return " ".join(str(error).split())
