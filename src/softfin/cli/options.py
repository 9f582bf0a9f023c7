"""The fields of a dataclass as options of a command: read from words, checked, and listed as help.

A field without a default is required. A bool is a flag, a Literal a choice, a tuple an option that may be repeated (or
several positional arguments). `Option`, in the field's annotation, says the rest.
"""

import ast
import dataclasses
import difflib
import inspect
import shutil
import sys
import textwrap
import types
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from softfin.core.errors import ConfigurationError

Arguments = TypeVar("Arguments")

NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}
METAVARS: dict[Any, str] = {int: "INT", float: "FLOAT", Path: "PATH", str: "TEXT"}
INDENT = 18
"""Columns before the text of an option in help."""


class HelpRequested(Exception):
    """``--help`` was among the words."""


@dataclasses.dataclass(frozen=True)
class Option:
    """What a field's type does not say of its option."""

    metavar: str | None = None
    """What stands for the value in help and messages; by default the type: INT, FLOAT, PATH, TEXT."""
    positional: bool = False
    """Given without a name, by its place."""
    parse: Callable[[str, str], Any] | None = None
    """Function of the text and the option's name that returns the value; raises ConfigurationError."""
    check: Callable[[Any, Any], object] | None = None
    """Raises a SoftfinError where the value, of a whole command, names what is not there: before anything is done."""


@dataclasses.dataclass(frozen=True)
class Field:
    """One option of a command."""

    field: str
    option: Option
    kind: Any
    """int, float, str, Path, bool, or a Literal; anything where the option has a parser of its own."""
    repeats: bool
    required: bool
    default: Any

    @property
    def choices(self) -> tuple[str, ...]:
        """The values that are allowed, where they are listed."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def metavar(self) -> str:
        """What stands for the value."""
        return self.option.metavar or "|".join(self.choices) or METAVARS[self.kind]

    @property
    def name(self) -> str:
        """As it is typed: ``--test-logs``; of a positional argument its metavar."""
        return self.metavar if self.option.positional else f"--{self.field.replace('_', '-')}"

    @property
    def usage(self) -> str:
        """With its value: ``--test-logs INT``."""
        if self.option.positional:
            return f"{self.metavar} ..." if self.repeats else self.metavar
        return self.name if self.kind is bool else f"{self.name} {self.metavar}"

    def read(self, text: str) -> Any:
        """The value that a text stands for; raises ConfigurationError."""
        shown = repr(text) if self.option.positional else f"{self.name} {text}"
        if self.option.parse is not None:
            return self.option.parse(text, self.name)
        if self.choices:
            if text in self.choices:
                return text
            allowed = ", ".join(self.choices)
            raise ConfigurationError(f"{shown}: choose one of {allowed}{_nearest(text, self.choices)}")
        if self.kind in NUMBERS:
            try:
                return self.kind(text)
            except ValueError:
                raise ConfigurationError(f"{shown}: not {NUMBERS[self.kind]}; write {self.usage}") from None
        if self.kind is Path and not text:
            raise ConfigurationError(f"{self.name}: the path is empty; write {self.usage}")
        return self.kind(text)


def _nearest(met: str, allowed: Iterable[str], otherwise: str = "") -> str:
    close = difflib.get_close_matches(met, list(allowed), n=1)
    return f"; did you mean {close[0]}?" if close else otherwise


def fields_of(command: type[Any]) -> list[Field]:
    """The options of a command: its own first, then those that it inherits."""
    hints = get_type_hints(command, include_extras=True)
    found = {field.name: _field(field, hints[field.name]) for field in dataclasses.fields(command)}
    own = [name for base in command.__mro__ for name in inspect.get_annotations(base) if name in found]
    return [found[name] for name in dict.fromkeys(own)]


def _field(field: "dataclasses.Field[Any]", hint: Any) -> Field:
    option, repeats = Option(), False
    while True:
        origin, parts = get_origin(hint), get_args(hint)
        if origin is Annotated:
            option = next((part for part in parts[1:] if isinstance(part, Option)), option)
            if option.parse is not None:
                break
            hint = parts[0]
        elif origin in (types.UnionType, Union):
            hint = next(part for part in parts if part is not type(None))
        elif origin is tuple and parts[1:] == (...,):
            hint, repeats = parts[0], True
        else:
            break
    return Field(field.name, option, hint, repeats, field.default is dataclasses.MISSING, field.default)


def parse(command: type[Arguments], words: Sequence[str]) -> Arguments:
    """The command that the words ask for; raises ConfigurationError in one line, or HelpRequested."""
    fields = fields_of(command)
    named = {field.name: field for field in fields if not field.option.positional}
    places = [field for field in fields if field.option.positional]
    values: dict[str, Any] = {}

    def take(field: Field, text: str) -> None:
        value = field.read(text)
        values[field.field] = (*values.get(field.field, ()), value) if field.repeats else value

    def take_place(text: str) -> None:
        place = next((field for field in places if field.repeats or field.field not in values), None)
        if place is None:
            expected = " ".join(field.usage for field in places) or "only options"
            raise ConfigurationError(f"{text!r}: one argument too many; the command takes {expected}")
        take(place, text)

    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in ("-h", "--help"):
            raise HelpRequested
        if word == "--":
            for text in rest:
                take_place(text)
            break
        if not _is_option(word):
            take_place(word)
            continue
        written, sign, text = word.partition("=")
        field = named.get(written.replace("_", "-"))
        if field is None:
            nearest = _nearest(written, named, "; --help lists the options")
            raise ConfigurationError(f"{written}: unknown option{nearest}")
        if field.kind is bool:
            if sign:
                raise ConfigurationError(f"{word}: this option takes no value; write {field.name}, or leave it out")
            values[field.field] = True
            continue
        if not sign:
            if not rest or rest[0].startswith("--") or rest[0] == "-h":
                raise ConfigurationError(f"{field.name}: the value is missing; write {field.usage}")
            text = rest.pop(0)
        take(field, text)
    missing = [field.usage for field in fields if field.required and field.field not in values]
    if missing:
        raise ConfigurationError(f"{', '.join(missing)}: required, and missing; --help tells more")
    return command(**values)


def _is_option(word: str) -> bool:
    """Whether a word is the name of an option: ``-1,2`` is a value."""
    return word.startswith("--") or (word[:1] == "-" and word[1:2].isalpha())


def check(command: Any) -> None:
    """Look at all that the values of a command name; raises a SoftfinError where one is not there."""
    for field in fields_of(type(command)):
        value = getattr(command, field.field)
        if field.option.check is None or value is None:
            continue
        for each in value if field.repeats else (value,):
            field.option.check(each, command)


def help_of(command: type[Any], program: str) -> str:
    """The help of a command, for the width of the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    fields, texts = fields_of(command), docstrings(command)
    places = [field for field in fields if field.option.positional]
    options = [field for field in fields if not field.option.positional]
    required = [field for field in options if field.required]
    usage = " ".join(["usage:", program, *(field.usage for field in (*places, *required)), "[OPTION ...]"])
    lines = [*_wrap(usage, width, " " * 7), ""]
    lines += _wrap(" ".join((command.__doc__ or "").split("\n\n")[0].split()), width)
    more = (command.__doc__ or "").split("\n\n")[1:]
    lines += [line for part in more for line in ("", *_wrap(" ".join(part.split()), width))]
    for title, group in (("arguments", places), ("options", [*required, *(o for o in options if not o.required)])):
        if group:
            lines += ["", f"{title}:"]
        for field in group:
            lines += _entry(field.usage, _described(field, texts.get(field.field, "")), width)
    return "\n".join([*lines, *_entry("-h, --help", "Show this help.", width)])


def _described(field: Field, text: str) -> str:
    notes = ["required"] if field.required and not field.option.positional else []
    if field.repeats and not field.option.positional:
        notes.append("may be repeated")
    if not (field.required or field.default is None or field.default is False or field.default == ()):
        notes.append(f"default: {field.default}")
    return f"{text} ({'; '.join(notes)})" if notes else text


def _entry(usage: str, text: str, width: int) -> list[str]:
    lines = _wrap(text, width - INDENT)
    if len(usage) + 4 <= INDENT and lines:
        return [f"  {usage:{INDENT - 2}}{lines[0]}", *(" " * INDENT + line for line in lines[1:])]
    return [f"  {usage}", *(" " * INDENT + line for line in lines)]


def _wrap(text: str, width: int, later: str = "") -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=later, break_on_hyphens=False)


def docstrings(command: type[Any]) -> dict[str, str]:
    """The string under each field, of a class and those that it inherits from."""
    texts: dict[str, str] = {}
    for base in reversed(command.__mro__[:-1]):
        for node in ast.parse(inspect.getsource(sys.modules[base.__module__])).body:
            if isinstance(node, ast.ClassDef) and node.name == base.__name__:
                for field, text in pairwise(node.body):
                    match field, text:
                        case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(words))):
                            texts[name] = " ".join(words.split())
    return texts
