"""Command-line options from the fields of a class: parsing, checks and help.

A field without a default is required. A bool is a flag, a Literal is a choice, and a tuple is a
repeatable option (or several positional arguments). An `Option` in the field's annotation adds
properties that the type does not express.
"""

import difflib
import inspect
import re
import shutil
import textwrap
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic.fields import FieldInfo

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError

Arguments = TypeVar("Arguments", bound=Configuration)

NUMBERS: dict[object, tuple[str, Callable[[str], float]]] = {
    int: ("a whole number", int),
    float: ("a number", float),
}
"""Name and parser of each numeric type."""
METAVARS: dict[object, str] = {int: "INT", float: "FLOAT", Path: "PATH"}
INDENT = 18
"""Width of the column of option names in the help [characters]."""


class HelpRequested(Exception):
    """Raised if ``--help`` is among the arguments."""


@dataclass(frozen=True)
class Option:
    """Properties of an option that its type does not express."""

    metavar: str | None = None
    """Placeholder for the value in help and messages (default: the type, as INT, FLOAT, PATH or
    TEXT)."""
    positional: bool = False
    """Whether the option is a positional argument."""
    parse: Callable[[str, str], object] | None = None
    """Function that takes a text and the option's name and returns the value; raises
    ConfigurationError."""
    check: Callable[[str | Path, Configuration], object] | None = None
    """Function that takes a value and its command, and raises a SoftfinError if a file, folder or
    plant does not exist."""
    choices: Callable[[], Iterable[str]] = tuple
    """Function that lists the allowed values, if only the running program knows them."""
    former_name: str | None = None
    """Name of the option before it was renamed; the error for the old name suggests the new one."""


@dataclass(frozen=True)
class Field:
    """One option of a command."""

    field: str
    option: Option
    kind: object
    """int, float, Path, bool or a Literal. Values of other types are parsed by the option's parser
    or by the command."""
    repeats: bool
    required: bool
    default: object
    text: str
    """Description of the option."""
    section: str
    """Heading of the option in the help."""

    @property
    def choices(self) -> tuple[str, ...]:
        """Allowed values of the option or of a Literal; empty if any value is allowed."""
        return (
            get_args(self.kind)
            if get_origin(self.kind) is Literal
            else tuple(self.option.choices())
        )

    @property
    def metavar(self) -> str:
        """Placeholder for the value."""
        return self.option.metavar or "|".join(self.choices) or METAVARS.get(self.kind, "TEXT")

    @property
    def name(self) -> str:
        """The option as typed, such as ``--test-logs``; the metavar of a positional argument."""
        # Field names end in their unit; option names omit it, to save typing.
        field = re.sub("_(hz|rad_s|ms|s|)$", "", self.field)
        return self.metavar if self.option.positional else f"--{field.replace('_', '-')}"

    @property
    def usage(self) -> str:
        """The option with its value, such as ``--test-logs INT``."""
        if self.option.positional:
            return f"{self.metavar} ..." if self.repeats else self.metavar
        return self.name if self.kind is bool else f"{self.name} {self.metavar}"

    def read(self, text: str) -> object:
        """Parse the text of a value; raises ConfigurationError."""
        shown = repr(text) if self.option.positional else f"{self.name} {text}"
        if self.option.parse is not None:
            return self.option.parse(text, self.name)
        if self.choices:
            if text in self.choices:
                return text
            allowed = ", ".join(self.choices)
            raise ConfigurationError(
                f"{shown}: must be one of {allowed}{_nearest(text, self.choices)}"
            )
        if self.kind in NUMBERS:
            name, number = NUMBERS[self.kind]
            try:
                return number(text)
            except ValueError:
                raise ConfigurationError(f"{shown}: not {name}; use {self.usage}") from None
        if self.kind is Path and not text:
            raise ConfigurationError(f"{self.name}: the path is empty; use {self.usage}")
        return Path(text) if self.kind is Path else text


def _nearest(met: str, allowed: Iterable[str], otherwise: str = "") -> str:
    close = difflib.get_close_matches(met, list(allowed), n=1)
    return f"; did you mean {close[0]}?" if close else otherwise


def list_fields(command: type[Configuration]) -> list[Field]:
    """Return the options of a command: its own first, then inherited ones."""
    hints = get_type_hints(command, include_extras=True)
    # Pydantic lists inherited fields first, but the help starts with the command's own.
    annotated = chain.from_iterable(map(inspect.get_annotations, command.__mro__))
    fields = []
    for name in dict.fromkeys(annotated):
        if name in command.model_fields:
            info = command.model_fields[name]
            fields.append(_field(name, hints[name], info, _section(command, name)))
    return fields


def _section(command: type[Configuration], name: str) -> str:
    """Return the `HELP_TITLE` of the base class that adds the option, if it has one."""
    section = "options"
    for base in command.__mro__:
        # The last one wins, because it is the base class that introduces the field.
        if "HELP_TITLE" in vars(base) and name in getattr(base, "model_fields", ()):
            section = vars(base)["HELP_TITLE"]
    return section


def _field(name: str, hint: object, info: FieldInfo, section: str) -> Field:
    option = Option()
    repeats = False
    # Unwrap Annotated, `| None` and `tuple[..., ...]` from the outside in, until the type remains.
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
    places, options = _split_positional(fields)
    named = {field.name: field for field in options}
    values: dict[str, object] = {}
    repeated: dict[str, list[object]] = {}

    def take(field: Field, text: str) -> None:
        value = field.read(text)
        if field.repeats:
            repeated.setdefault(field.field, []).append(value)
        else:
            values[field.field] = value

    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in ("-h", "--help"):
            raise HelpRequested
        # -1,2 is a value, not an option.
        if not word.startswith("--") and not (word[:1] == "-" and word[1:2].isalpha()):
            take(_next_place(places, values, word), word)
            continue
        field, text = _read_option(word, named, rest)
        if field.kind is bool:
            values[field.field] = True
        else:
            take(field, text)
    for name, each in repeated.items():
        values[name] = tuple(each)
    _check_required(fields, values)
    return command.build(values, "options")


def _split_positional(fields: Iterable[Field]) -> tuple[list[Field], list[Field]]:
    """Return the positional arguments, then the options."""
    places: list[Field] = []
    options: list[Field] = []
    for field in fields:
        (places if field.option.positional else options).append(field)
    return places, options


def _check_required(fields: Iterable[Field], values: Mapping[str, object]) -> None:
    missing = [field.usage for field in fields if field.required and field.field not in values]
    if missing:
        raise ConfigurationError(f"missing required {', '.join(missing)}; see --help")


def _next_place(places: Sequence[Field], values: Mapping[str, object], word: str) -> Field:
    """Return the positional argument that a word belongs to."""
    for field in places:
        if field.repeats or field.field not in values:
            return field
    expected = " ".join(field.usage for field in places) or "only options"
    raise ConfigurationError(f"{word!r}: unexpected argument; the command accepts {expected}")


def _read_option(word: str, named: Mapping[str, Field], rest: list[str]) -> tuple[Field, str]:
    """Return the option that a word names, and its value, which may be the next word."""
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
                f"{word}: this option does not accept a value; use {field.name} alone, or omit it"
            )
        return field, ""
    if sign:
        return field, text
    if not rest or rest[0].startswith("--") or rest[0] == "-h":
        raise ConfigurationError(f"{field.name}: missing value; use {field.usage}")
    return field, rest.pop(0)


def check_values(command: Configuration) -> None:
    """Check that the paths and names in a command's values exist; raises a SoftfinError if not."""
    for field in list_fields(type(command)):
        value = getattr(command, field.field)
        if field.option.check is not None and value is not None:
            for each in value if field.repeats else (value,):
                field.option.check(each, command)


def format_help(command: type[Configuration], program: str) -> str:
    """Return the help of a command, wrapped to the width of the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    places, options = _split_positional(list_fields(command))
    # The sort is stable: required options first, otherwise in the order of the fields.
    options.sort(key=lambda field: not field.required)
    usage = f"usage: {program}"
    for field in (*places, *options):
        if field.required:
            usage += f" {field.usage}"
        elif field.option.positional:
            usage += f" [{field.usage}]"
    lines = _wrap(f"{usage} [OPTION ...]", width, " " * 7)
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
    default = field.default
    if not (field.required or default is None or default is False or default in ((), {})):
        values = default if field.repeats and isinstance(default, tuple) else (default,)
        notes.append(f"default: {' '.join(map(str, values))}")
    return f" ({'; '.join(notes)})" if notes else ""


def _entry(usage: str, text: str, width: int) -> list[str]:
    lines = _wrap(text, width - INDENT)
    if len(usage) + 4 <= INDENT and lines:
        return [f"  {usage:{INDENT - 2}}{lines[0]}", *(" " * INDENT + line for line in lines[1:])]
    return [f"  {usage}", *(" " * INDENT + line for line in lines)]


def _wrap(text: str, width: int, later: str = "") -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=later, break_on_hyphens=False)
