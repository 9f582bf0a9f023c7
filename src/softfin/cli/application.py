"""Turns a function into a command: its parameters are the options, its docstring is the help.

An option that is not a parameter is a field of a configuration. If the function has a parameter
whose type is a `Configuration`, such as `ImportConfig`, its fields are listed in the help. Other
options, such as ``--excitation.hold-min-s 0.2``, are fields of the parameter `config`.
"""

import difflib
import inspect
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from cyclopts import App, CycloptsError, Parameter
from cyclopts.argument import Argument
from cyclopts.exceptions import (
    CoercionError,
    MissingArgumentError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from softfin.core.configuration import Changes, Configuration, option_name
from softfin.core.errors import ConfigurationError

CONFIG = "config"
"""Name of the parameter that any field of a configuration changes."""

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


class Option(NamedTuple):
    """An option or a positional argument of a command."""

    name: str
    """The option, such as ``--rows``; the placeholder of a positional argument."""
    usage: str
    """The option with the placeholder of its value."""
    text: str
    """Its description."""
    default: object
    section: str
    """Heading in the help."""
    is_required: bool = False
    is_positional: bool = False


class Call(NamedTuple):
    """A function and the arguments that were typed for it."""

    function: Callable[..., object]
    positional: tuple[Any, ...]
    options: dict[str, Any]

    def run(self, **more: object) -> object:
        """Call the function, with `more` keyword arguments."""
        return self.function(*self.positional, **self.options, **more)


def parse(function: Callable[..., object], words: Sequence[str]) -> Call:
    """Parse the words of a command; raises ConfigurationError with a one-line message."""
    app = _make_app(function)
    arguments = list(app.assemble_argument_collection())
    names = [name for argument in arguments if argument.parse for name in argument.names]
    kinds = _configurations(function)
    fields = {
        _field_option(field): parameter
        for parameter, kind in kinds.items()
        for field in kind.model_fields
    }
    is_configured = CONFIG in inspect.signature(function).parameters
    rest, typed = _split(words, names, fields, is_configured)
    try:
        _, bound, _ = app.parse_args(rest, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise ConfigurationError(_explain(error, arguments)) from None
    options = dict(bound.kwargs)
    for parameter, kind in kinds.items():
        by_option = {_field_option(field): field for field in kind.model_fields}
        values = {by_option[name]: typed.pop(name) for name in by_option if name in typed}
        if values:
            options[parameter] = kind.build(values, "options")
    file = options.get(CONFIG)
    if file is not None or typed:
        options[CONFIG] = Changes(None if file is None else Path(file), typed, [*names, *fields])
    return Call(function, bound.args, options)


def _make_app(function: Callable[..., object]) -> App:
    defaults = Parameter(negative=(), name_transform=option_name)
    app = App(default_parameter=defaults, help_flags=(), version_flags=())
    app.default(function)
    return app


def _configurations(function: Callable[..., object]) -> dict[str, type[Configuration]]:
    """Return the parameters of a function that are configurations, each field an option."""
    found = {}
    for name, hint in get_type_hints(function).items():
        for kind in (hint, *get_args(hint)):
            if isinstance(kind, type) and issubclass(kind, Configuration):
                found[name] = kind
    return found


def _field_option(field: str) -> str:
    return f"--{option_name(field)}"


def _split(
    words: Sequence[str], names: Sequence[str], fields: Iterable[str], is_configured: bool
) -> tuple[list[str], dict[str, str]]:
    """Return the words for the function's own parameters, and the values of configurations'
    fields."""
    rest: list[str] = []
    values: dict[str, str] = {}
    left = list(words)
    while left:
        word = left.pop(0)
        written, sign, text = word.partition("=")
        option = written.replace("_", "-")
        if re.match(r"-[\d.]", word) and rest and rest[-1] in names:
            # -1,2 is the value of an option, not an option.
            rest[-1] += f"={word}"
        elif not word.startswith("--"):
            rest.append(word)
        elif option in names or not (option in fields or is_configured):
            rest.append(option + sign + text)
        elif sign:
            values[option] = text
        elif left and not left[0].startswith("--"):
            values[option] = left.pop(0)
        elif option in fields:
            raise ConfigurationError(f"{option}: missing value")
        else:
            raise ConfigurationError(
                f"{option}: unknown option, or missing value{_nearest(option, [*names, *fields])}"
            )
    return rest, values


def _nearest(written: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(written, list(names), n=1)
    return f"; did you mean {close[0]}?" if close else "; --help lists the options"


def _explain(error: CycloptsError, arguments: Sequence[Argument]) -> str:
    """Return cyclopts' error in the form of softfin's messages."""
    if isinstance(error, UnknownOptionError):
        written = (error.token.keyword or error.token.value).partition("=")[0]
        names = [name for argument in arguments if argument.parse for name in argument.names]
        return f"{written}: unknown option{_nearest(written, names)}"
    if isinstance(error, UnusedCliTokensError):
        word = (error.unused_tokens or [""])[0]
        places = " ".join(_usage(each) for each in arguments if _is_positional(each))
        return f"{word!r}: unexpected argument; the command accepts {places or 'only options'}"
    if error.argument is not None:
        return _explain_value(error, error.argument)
    error.verbose = False
    return str(error)


def _explain_value(error: CycloptsError, argument: Argument) -> str:
    """Return an error about the value of one argument."""
    if isinstance(error, MissingArgumentError):
        if error.keyword:
            return f"{error.keyword}: missing value; use {_usage(argument)}"
        return f"missing required {_usage(argument)}; see --help"
    error.verbose = False
    if not isinstance(error, CoercionError) or error.token is None:
        return f"{argument.name}: {error}"
    value = error.token.value
    shown = repr(value) if _is_positional(argument) else f"{argument.name} {value}"
    if allowed := _choices(argument.hint):
        close = difflib.get_close_matches(value, allowed, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        return f"{shown}: must be one of {', '.join(allowed)}{hint}"
    if argument.is_flag():
        return f"{shown}: does not accept a value; use {argument.name} alone, or omit it"
    for kind, (_, name) in KINDS.items():
        if kind in (argument.hint, *get_args(argument.hint)):
            return f"{shown}: not {name}; use {_usage(argument)}"
    return f"{shown}: {error.msg}"


def _is_positional(argument: Argument) -> bool:
    return argument.field_info.kind is not inspect.Parameter.KEYWORD_ONLY


def _choices(hint: object) -> tuple[str, ...]:
    """Return the allowed values of a Literal, also if it is optional or repeated."""
    for each in (hint, *get_args(hint)):
        if get_origin(each) is Literal:
            return get_args(each)
    return ()


def _metavar(hint: object) -> str:
    if get_origin(hint) is dict:
        return "NAME=VALUE"
    for kind, (name, _) in KINDS.items():
        if kind in (hint, *get_args(hint)):
            return name
    return "|".join(_choices(hint)) or "TEXT"


def _usage(argument: Argument) -> str:
    """Return an argument as typed, such as ``--test-logs INT``."""
    metavar = argument.parameter.metavar
    if _is_positional(argument):
        name = metavar or argument.field_info.name.upper()
        return f"{name} ..." if argument.is_var_positional() else name
    return (
        argument.name
        if argument.is_flag()
        else f"{argument.name} {metavar or _metavar(argument.hint)}"
    )


def list_options(function: Callable[..., object]) -> list[Option]:
    """Return the options of a command as in its help: positional arguments, then required
    options."""
    arguments = _make_app(function).assemble_argument_collection(parse_docstring=True)
    options = [_option(argument) for argument in arguments if argument.show]
    for kind in _configurations(function).values():
        section = inspect.cleandoc(kind.__doc__ or "").partition("\n")[0].rstrip(".").lower()
        for field, info in kind.model_fields.items():
            name = _field_option(field)
            default = info.get_default(call_default_factory=True)
            usage = f"{name} {_metavar(info.annotation)}"
            options.append(Option(name, usage, info.description or "", default, section))
    # The sort is stable.
    return sorted(options, key=lambda option: (not option.is_positional, not option.is_required))


def _option(argument: Argument) -> Option:
    is_positional = _is_positional(argument)
    section = "arguments" if is_positional else "options"
    return Option(
        name=_usage(argument) if is_positional else argument.name,
        usage=_usage(argument),
        text=argument.parameter.help or "",
        default=argument.field_info.default,
        section="general options" if argument.name in GENERAL else section,
        is_required=argument.required,
        is_positional=is_positional,
    )


def format_help(function: Callable[..., object], program: str) -> str:
    """Return the help of a command, wrapped to the width of the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    options = list_options(function)
    usage = program
    for option in options:
        if option.is_required:
            usage += f" {option.usage}"
        elif option.is_positional:
            usage += f" [{option.usage}]"
    lines = _wrap(f"usage: {usage} [OPTION ...]", width, " " * 7)
    for paragraph in _description(function):
        lines += ["", *_wrap(paragraph, width)]
    groups: dict[str, list[tuple[str, str]]] = {}
    for option in options:
        groups.setdefault(option.section, []).append((option.usage, _text(option)))
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


def _text(option: Option) -> str:
    """Return the description of an option, with its default."""
    text = " ".join(option.text.replace("`", "").split()).removesuffix(".")
    if option.is_required:
        return text if option.is_positional else f"{text} (required)"
    default = option.default
    if isinstance(default, bool) or default in (None, (), {}, inspect.Parameter.empty):
        return text
    values = default if isinstance(default, tuple) else (default,)
    return f"{text} (default: {' '.join(map(str, values))})"


def _entry(name: str, text: str, width: int) -> list[str]:
    lines = _wrap(text, width - INDENT)
    if len(name) + 4 <= INDENT and lines:
        return [f"  {name:{INDENT - 2}}{lines[0]}", *(" " * INDENT + line for line in lines[1:])]
    return [f"  {name}", *(" " * INDENT + line for line in lines)]


def _wrap(text: str, width: int, later: str = "") -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=later, break_on_hyphens=False)
