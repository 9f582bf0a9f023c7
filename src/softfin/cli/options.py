"""The fields of a class as options of a command: parsed, checked, and listed in the help.

A field without a default is required. A bool is a flag, a Literal a choice, a tuple an option that
may be repeated (or several positional arguments). `Option`, in the field's annotation, adds what
the type does not tell.
"""

import difflib
import inspect
import re
import shutil
import textwrap
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic.fields import FieldInfo

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError

Arguments = TypeVar("Arguments", bound=Configuration)

NUMBER_NAMES: dict[Any, str] = {int: "a whole number", float: "a number"}
METAVARS: dict[Any, str] = {int: "INT", float: "FLOAT", Path: "PATH"}
INDENT = 18
"""Width of the column of option names in the help."""


class HelpRequested(Exception):
    """Raised if ``--help`` is among the arguments."""


@dataclass(frozen=True)
class Option:
    """How an option is written, parsed and checked, if its type does not tell."""

    metavar: str | None = None
    """Placeholder of the value in help and messages; by default the type: INT, FLOAT, PATH,
    TEXT."""
    positional: bool = False
    """Whether the option is a positional argument."""
    parse: Callable[[str, str], Any] | None = None
    """Function that parses the text, given the name of the option; raises ConfigurationError."""
    check: Callable[[Any, Any], object] | None = None
    """Function that checks the value, given its command; raises a SoftfinError if something that it
    names does not exist."""
    former_name: str | None = None
    """Name that the option had before it was renamed; the error for it suggests the new name."""


@dataclass(frozen=True)
class Field:
    """One option of a command."""

    field: str
    option: Option
    kind: Any
    """int, float, Path, bool or a Literal; for anything else the option has a parser, or the
    command parses the text."""
    repeats: bool
    required: bool
    default: Any
    text: str
    """Description of the option."""
    section: str
    """Title under which help lists the option."""

    @property
    def choices(self) -> tuple[str, ...]:
        """The allowed values, if they are listed."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def metavar(self) -> str:
        """Placeholder of the value."""
        return self.option.metavar or "|".join(self.choices) or METAVARS.get(self.kind, "TEXT")

    @property
    def name(self) -> str:
        """The option as typed, such as ``--test-logs``; the metavar of a positional argument."""
        # A field may end in its unit, which nobody should have to type.
        field = re.sub("_(hz|rad_s|ms|s|)$", "", self.field)
        return self.metavar if self.option.positional else f"--{field.replace('_', '-')}"

    @property
    def usage(self) -> str:
        """The option with its value, such as ``--test-logs INT``."""
        if self.option.positional:
            return f"{self.metavar} ..." if self.repeats else self.metavar
        return self.name if self.kind is bool else f"{self.name} {self.metavar}"

    def read(self, text: str) -> Any:
        """Return the value that a text stands for; raises ConfigurationError."""
        shown = repr(text) if self.option.positional else f"{self.name} {text}"
        if self.option.parse is not None:
            return self.option.parse(text, self.name)
        if self.choices:
            if text in self.choices:
                return text
            allowed = ", ".join(self.choices)
            raise ConfigurationError(
                f"{shown}: choose one of {allowed}{_nearest(text, self.choices)}"
            )
        if self.kind in NUMBER_NAMES:
            try:
                return self.kind(text)
            except ValueError:
                raise ConfigurationError(
                    f"{shown}: not {NUMBER_NAMES[self.kind]}; write {self.usage}"
                ) from None
        if self.kind is Path and not text:
            raise ConfigurationError(f"{self.name}: the path is empty; write {self.usage}")
        return Path(text) if self.kind is Path else text


def _nearest(met: str, allowed: Iterable[str], otherwise: str = "") -> str:
    close = difflib.get_close_matches(met, list(allowed), n=1)
    return f"; did you mean {close[0]}?" if close else otherwise


def list_fields(command: type[Configuration]) -> list[Field]:
    """List the options of a command: its own first, then inherited ones."""
    hints = get_type_hints(command, include_extras=True)
    found = command.model_fields
    own = [
        name for base in command.__mro__ for name in inspect.get_annotations(base) if name in found
    ]
    return [
        _field(name, hints[name], found[name], _section(command, name))
        for name in dict.fromkeys(own)
    ]


def _section(command: type[Configuration], name: str) -> str:
    """Return the `HELP_TITLE` of the base class that adds the option, if it has one."""
    titles = [
        vars(base)["HELP_TITLE"]
        for base in command.__mro__
        if "HELP_TITLE" in vars(base) and name in getattr(base, "model_fields", ())
    ]
    return titles[-1] if titles else "options"


def _field(name: str, hint: object, info: FieldInfo, section: str) -> Field:
    option = Option()
    repeats = False
    while True:
        origin = get_origin(hint)
        parts = get_args(hint)
        if origin is Annotated:
            option = next((part for part in parts[1:] if isinstance(part, Option)), option)
            if option.parse is not None:
                break
            hint = parts[0]
        elif origin in (types.UnionType, Union):
            hint = next(part for part in parts if part is not type(None))
        elif origin is tuple and parts[1:] == (...,):
            hint = parts[0]
            repeats = True
        else:
            break
    text = " ".join((info.description or "").replace("``", "").split())
    default = info.get_default(call_default_factory=True)
    return Field(name, option, hint, repeats, info.is_required(), default, text, section)


def parse(command: type[Arguments], words: Sequence[str]) -> Arguments:
    """Build the command from its arguments; raises ConfigurationError with a one-line message, or
    HelpRequested."""
    fields = list_fields(command)
    named = {field.name: field for field in fields if not field.option.positional}
    places = [field for field in fields if field.option.positional]
    values: dict[str, Any] = {}

    def take(field: Field, text: str) -> None:
        value = field.read(text)
        values[field.field] = (*values.get(field.field, ()), value) if field.repeats else value

    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in ("-h", "--help"):
            raise HelpRequested
        # -1,2 is a value, not an option.
        if not word.startswith("--") and not (word[:1] == "-" and word[1:2].isalpha()):
            place = next(
                (field for field in places if field.repeats or field.field not in values), None
            )
            if place is None:
                expected = " ".join(field.usage for field in places) or "only options"
                raise ConfigurationError(
                    f"{word!r}: one argument too many; the command takes {expected}"
                )
            take(place, word)
            continue
        field, text = _read_option(word, named, rest)
        if field.kind is bool:
            values[field.field] = True
        else:
            take(field, text)
    missing = [field.usage for field in fields if field.required and field.field not in values]
    if missing:
        raise ConfigurationError(f"{', '.join(missing)}: required, and missing; --help tells more")
    return command.build(values, "options")


def _read_option(word: str, named: Mapping[str, Field], rest: list[str]) -> tuple[Field, str]:
    """Return the option named by a word, and its value, which may be the next word."""
    written, sign, text = word.partition("=")
    field = named.get(written.replace("_", "-"))
    if field is None:
        nearest = _nearest(written, named, "; --help lists the options")
        for other in named.values():
            if other.option.former_name == written:
                nearest = f"; did you mean {other.name}?"
        raise ConfigurationError(f"{written}: unknown option{nearest}")
    if field.kind is bool:
        if sign:
            raise ConfigurationError(
                f"{word}: this option takes no value; write {field.name}, or leave it out"
            )
        return field, ""
    if sign:
        return field, text
    if not rest or rest[0].startswith("--") or rest[0] == "-h":
        raise ConfigurationError(f"{field.name}: the value is missing; write {field.usage}")
    return field, rest.pop(0)


def check_values(command: Any) -> None:
    """Check the paths and names in the values of a command; raises a SoftfinError if one does not
    exist."""
    for field in list_fields(type(command)):
        if field.option.check is not None and (value := getattr(command, field.field)) is not None:
            for each in value if field.repeats else (value,):
                field.option.check(each, command)


def format_help(command: type[Configuration], program: str) -> str:
    """Return the help of a command, for the width of the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    fields = list_fields(command)
    places = [field for field in fields if field.option.positional]
    options = sorted(
        (field for field in fields if not field.option.positional),
        key=lambda field: not field.required,
    )
    shown = [
        field.usage for field in (*places, *options) if field.required or field.option.positional
    ]
    lines = _wrap(" ".join(["usage:", program, *shown, "[OPTION ...]"]), width, " " * 7)
    for paragraph in (command.__doc__ or "").split("\n\n"):
        lines += ["", *_wrap(" ".join(paragraph.split()), width)]
    groups = {"arguments": places} if places else {}
    for field in options:
        groups.setdefault(field.section, []).append(field)
    for title, group in groups.items():
        lines += ["", f"{title}:"]
        for field in group:
            lines += _entry(field.usage, field.text.removesuffix(".") + _notes(field), width)
    return "\n".join([*lines, *_entry("-h, --help", "Show this help", width)])


def _notes(field: Field) -> str:
    notes = ["required"] if field.required and not field.option.positional else []
    if field.repeats and not field.option.positional:
        notes.append("may be repeated")
    if not (
        field.required
        or field.default is None
        or field.default is False
        or field.default in ((), {})
    ):
        values = field.default if field.repeats else (field.default,)
        notes.append(f"default: {' '.join(map(str, values))}")
    return f" ({'; '.join(notes)})" if notes else ""


def _entry(usage: str, text: str, width: int) -> list[str]:
    lines = _wrap(text, width - INDENT)
    if len(usage) + 4 <= INDENT and lines:
        return [f"  {usage:{INDENT - 2}}{lines[0]}", *(" " * INDENT + line for line in lines[1:])]
    return [f"  {usage}", *(" " * INDENT + line for line in lines)]


def _wrap(text: str, width: int, later: str = "") -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=later, break_on_hyphens=False)
