"""Turns a function into a command: its parameters are the options, its docstring is the help.

An option that is not a parameter is a field of the function's configuration, such as
``--excitation.hold-min-s 0.2``; it changes the file given by ``--config``.
"""

import difflib
import inspect
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

from cyclopts import App, CycloptsError, Parameter
from cyclopts.argument import Argument
from cyclopts.exceptions import (
    CoercionError,
    MissingArgumentError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from softfin.core.configuration import Changes, option_name
from softfin.core.errors import ConfigurationError

CONFIG = "config"
"""Name of the parameter that takes a configuration."""

KINDS: dict[object, tuple[str, str]] = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
}
"""Placeholder and description of the values of each numeric type."""

GENERAL = ("--config", "--overwrite")
"""Parameters that are shown with the options that every command has."""

GENERAL_TEXTS = {
    "--json": "Print the result as JSON",
    "--debug": "Show the traceback of an error",
    "-h, --help": "Show this help",
}
"""Help of the options that every command has."""

INDENT = 18
"""Width of the column of option names in the help [characters]."""


class Call(NamedTuple):
    """What was typed."""

    function: Callable[..., object]
    options: dict[str, Any]
    """Keyword arguments of the function that were given."""
    positional: tuple[Any, ...]
    """Positional arguments of the function that were given."""

    def run(self, **more: object) -> object:
        """Call the function, with `more` keyword arguments."""
        return self.function(*self.positional, **self.options, **more)


def make_app(function: Callable[..., object]) -> App:
    """Return the application that parses the arguments of a function."""
    defaults = Parameter(negative=(), name_transform=option_name)
    app = App(default_parameter=defaults, help_flags=(), version_flags=())
    app.default(function)
    return app


def list_arguments(function: Callable[..., object]) -> list[Argument]:
    """Return the arguments that can be typed, with their help texts."""
    collection = make_app(function).assemble_argument_collection(parse_docstring=True)
    return [argument for argument in collection if argument.show]


def parse(function: Callable[..., object], words: Sequence[str]) -> Call:
    """Parse the words of a command; raises ConfigurationError with a one-line message."""
    app = make_app(function)
    arguments = list(app.assemble_argument_collection())
    names = tuple(name for argument in arguments for name in argument.names if argument.parse)
    rest, changes = _split(words, names, CONFIG in inspect.signature(function).parameters)
    try:
        _, bound, _ = app.parse_args(rest, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise ConfigurationError(_explain(error, arguments)) from None
    options = dict(bound.kwargs)
    file = options.get(CONFIG)
    if file is not None or changes:
        options[CONFIG] = Changes(None if file is None else Path(file), changes, names)
    return Call(function, options, bound.args)


def _split(
    words: Sequence[str], names: tuple[str, ...], configured: bool
) -> tuple[list[str], dict[str, str]]:
    """Return the words for the function's own parameters, and the fields of its configuration."""
    rest: list[str] = []
    changes: dict[str, str] = {}
    words = list(words)
    while words:
        word = words.pop(0)
        written, sign, text = word.partition("=")
        option = written.replace("_", "-")
        if not word.startswith("--"):
            # -1,2 is a value, not an option.
            is_value = re.match(r"-[\d.]", word) and rest and rest[-1] in names
            rest[-1:] = [f"{rest[-1]}={word}"] if is_value else [*rest[-1:], word]
        elif option in names or not configured:
            rest.append(option + sign + text)
        else:
            if not sign and (not words or words[0].startswith("--")):
                raise ConfigurationError(f"{word}: unknown option{_nearest(option, names)}")
            changes[option] = text if sign else words.pop(0)
    return rest, changes


def _nearest(written: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(written, list(names), n=1)
    return f"; did you mean {close[0]}?" if close else "; --help lists the options"


def _explain(error: CycloptsError, arguments: Sequence[Argument]) -> str:
    """Return cyclopts' error in the form of softfin's messages."""
    if isinstance(error, UnknownOptionError):
        written = (error.token.keyword or error.token.value).partition("=")[0]
        names = [name for argument in arguments for name in argument.names if argument.parse]
        return f"{written}: unknown option{_nearest(written, names)}"
    if isinstance(error, UnusedCliTokensError):
        places = " ".join(usage(each) for each in arguments if is_positional(each))
        word = (error.unused_tokens or [""])[0]
        return f"{word!r}: unexpected argument; the command accepts {places or 'only options'}"
    argument = error.argument
    if argument is None:
        error.verbose = False
        return str(error)
    if isinstance(error, MissingArgumentError):
        if error.keyword:
            return f"{error.keyword}: missing value; use {usage(argument)}"
        return f"missing required {usage(argument)}; see --help"
    if isinstance(error, CoercionError) and error.token is not None:
        value = error.token.value
        shown = repr(value) if is_positional(argument) else f"{argument.name} {value}"
        if allowed := choices(argument):
            close = difflib.get_close_matches(value, allowed, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            return f"{shown}: must be one of {', '.join(allowed)}{hint}"
        if argument.hint in KINDS:
            return f"{shown}: not {KINDS[argument.hint][1]}; use {usage(argument)}"
        return f"{shown}: {error.msg}; use {usage(argument)}"
    error.verbose = False
    return f"{argument.name}: {error}"


def is_positional(argument: Argument) -> bool:
    """Whether an argument is given by its place."""
    return argument.field_info.kind is not inspect.Parameter.KEYWORD_ONLY


def choices(argument: Argument) -> tuple[str, ...]:
    """Return the allowed values of an argument whose type is a Literal; empty for other types."""
    for hint in (argument.hint, *get_args(argument.hint)):
        if get_origin(hint) is Literal:
            return get_args(hint)
    return ()


def usage(argument: Argument) -> str:
    """Return an argument as typed, such as ``--test-logs INT``."""
    metavar = argument.parameter.metavar
    if is_positional(argument):
        name = metavar or argument.field_info.name.upper()
        return f"{name} ..." if argument.is_var_positional() else name
    if argument.is_flag():
        return argument.name
    if metavar is None:
        kinds = [
            KINDS[hint][0] for hint in (argument.hint, *get_args(argument.hint)) if hint in KINDS
        ]
        metavar = "|".join(choices(argument)) or next(iter(kinds), "TEXT")
    return f"{argument.name} {metavar}"


def format_help(function: Callable[..., object], program: str) -> str:
    """Return the help of a command, wrapped to the width of the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    arguments = list_arguments(function)
    positional = [argument for argument in arguments if is_positional(argument)]
    options = [argument for argument in arguments if not is_positional(argument)]
    # The sort is stable: required options first, otherwise in the order of the parameters.
    options.sort(key=lambda argument: not argument.required)
    words = [usage(each) if each.required else f"[{usage(each)}]" for each in positional]
    words += [usage(each) for each in options if each.required]
    lines = _wrap(f"usage: {' '.join([program, *words])} [OPTION ...]", width, " " * 7)
    for paragraph in _description(function):
        lines += ["", *_wrap(paragraph, width)]
    groups: dict[str, list[tuple[str, str]]] = {}
    for argument in (*positional, *options):
        text = _text(argument)
        groups.setdefault(_section(argument), []).append((usage(argument), text))
    groups["general options"] = [*groups.pop("general options", []), *GENERAL_TEXTS.items()]
    for title, group in groups.items():
        lines += ["", f"{title}:"]
        for name, text in group:
            lines += _entry(name, text, width)
    return "\n".join(lines)


def _description(function: Callable[..., object]) -> Iterator[str]:
    """Yield the paragraphs of a docstring that come before its sections."""
    for paragraph in (inspect.getdoc(function) or "").split("\n\n"):
        if re.match(r"\w+:\n", paragraph):
            return
        yield " ".join(paragraph.replace("`", "").split())


def _section(argument: Argument) -> str:
    if is_positional(argument):
        return "arguments"
    if argument.name in GENERAL:
        return "general options"
    names = [group.name for group in argument.parameter.group or () if group.name]
    return names[0] if names and names[0] != "Parameters" else "options"


def _text(argument: Argument) -> str:
    """Return the help of an argument, with its default."""
    text = " ".join((argument.parameter.help or "").replace("`", "").split()).removesuffix(".")
    notes = []
    if argument.required and not is_positional(argument):
        notes.append("required")
    default = argument.field_info.default
    if default not in (None, False, (), inspect.Parameter.empty):
        values = default if isinstance(default, tuple) else (default,)
        notes.append(f"default: {' '.join(map(str, values))}")
    return f"{text} ({'; '.join(notes)})" if notes else text


def _entry(name: str, text: str, width: int) -> list[str]:
    lines = _wrap(text, width - INDENT)
    if len(name) + 4 <= INDENT and lines:
        return [f"  {name:{INDENT - 2}}{lines[0]}", *(" " * INDENT + line for line in lines[1:])]
    return [f"  {name}", *(" " * INDENT + line for line in lines)]


def _wrap(text: str, width: int, later: str = "") -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=later, break_on_hyphens=False)
