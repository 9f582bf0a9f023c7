"""Pages that are written from softfin itself: command line, configuration, Python, errors,
evidence. ``python -m docs.generate`` writes them.

They are kept in git, so that they can be read without a build; a test keeps them current. Sphinx
also runs this before each build (conf.py).
"""

import ast
import importlib
import inspect
import json
import re
import tempfile
import textwrap
import types
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from docs import messages
from results.parts import PARTS, SEEDS
from results.record import FOLDER, load, shown, source

import softfin
from softfin.cli import COMMANDS, import_function
from softfin.cli.application import format_help
from softfin.core import errors
from softfin.core.configuration import Configuration
from softfin.stages.example import write_example
from softfin.stages.explore import explore

ROOT = Path(__file__).parents[1]

MARK = "<!-- Below this line, the page is generated: python -m docs.generate -->\n"


def pages() -> dict[Path, str]:
    """Return the text of each page; what is above the mark is kept."""
    parts = {
        "reference/command-line": command_line(),
        "reference/configuration": configuration(),
        "reference/python": python(),
        "reference/errors": error_classes(),
        "evidence": evidence(),
    }
    texts = {}
    for name, lines in parts.items():
        file = ROOT / "docs" / f"{name}.md"
        above, mark, _ = file.read_text().partition(MARK)
        assert mark, f"{file}: the mark is missing"
        texts[file] = f"{above}{mark}\n" + "\n".join(lines).rstrip() + "\n"
    return texts


def write_pages() -> None:
    """Write the pages that have changed, so that Sphinx reads no page twice."""
    for file, text in pages().items():
        if file.read_text() != text:
            file.write_text(text)


def explorer(out: Path) -> None:
    """Write explorer.html of the example's controllers, which the first page shows."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        example = Path(folder) / "example"
        write_example(example)
        controllers = [
            path for name in ("single", "grid", "gaits") if (path := example / name).is_dir()
        ]
        plants = ("tank", str(example / "surrogate"))
        explore(*controllers, out=out / "explorer.html", plant=plants, overwrite=True)


def command_line() -> Iterator[str]:
    for name in COMMANDS:
        # As wide as a page.
        text = format_help(import_function(name), f"softfin {name}", width=92)
        yield from (f"## {name}", "", "```text", text, "```", "")


def configuration() -> Iterator[str]:
    from tests.test_documentation import CONFIGURATIONS

    shown: set[type] = set()
    for command, configurations in CONFIGURATIONS.items():
        yield from (f"## softfin {command}", "")
        names = list(dict.fromkeys(type(each).__name__ for each in configurations))
        yield from (", ".join(f"[`{name}`](#{name.lower()})" for name in names) + ".", "")
        for each in configurations:
            yield from _fields(type(each), shown)


def _fields(kind: type[Configuration], shown: set[type]) -> Iterator[str]:
    if kind in shown:
        return
    shown.add(kind)
    yield from (f"### {kind.__name__}", "", inspect.cleandoc(kind.__doc__ or ""), "")
    yield from ("| field | values | default | |", "| --- | --- | --- | --- |")
    inner = []
    for name, info in kind.model_fields.items():
        inner += [each for each in _configurations(info.annotation) if each not in shown]
        default = (
            "required"
            if info.is_required()
            else _default(info.get_default(call_default_factory=True))
        )
        text = " ".join((info.description or "").split()).replace("|", r"\|")
        yield f"| `{name}` | {_values(info)} | {default} | {text} |"
    yield ""
    for each in dict.fromkeys(inner):
        yield from _fields(each, shown)


def _configurations(annotation: Any) -> list[type[Configuration]]:
    if isinstance(annotation, type) and issubclass(annotation, Configuration):
        return [annotation]
    return [each for part in get_args(annotation) for each in _configurations(part)]


def _values(info: Any) -> str:
    limits = [_limit(each) for each in info.metadata]
    return ", ".join([_kind(info.annotation), *filter(None, limits)])


def _limit(limit: Any) -> str:
    signs = {
        "gt": ">",
        "ge": ">=",
        "lt": "<",
        "le": "<=",
        "min_length": "at least",
        "max_length": "at most",
    }
    return ", ".join(
        f"{sign}\u00a0{getattr(limit, name):g}"
        for name, sign in signs.items()
        if getattr(limit, name, None) is not None
    )


def _kind(annotation: Any) -> str:
    names = {
        int: "integer",
        float: "number",
        str: "text",
        bool: "true or false",
        type(None): "none",
        Path: "path",
    }
    if annotation in names:
        return names[annotation]
    origin = get_origin(annotation)
    parts = get_args(annotation)
    if origin is Annotated:
        limits = [_limit(each) for each in parts[1:]]
        return " ".join([_kind(parts[0]), *filter(None, limits)])
    if origin is Literal:
        return ", ".join(f"`{each}`" for each in parts)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_kind(each) for each in parts))
    if origin in (tuple, list):
        inner = list(dict.fromkeys(_kind(each) for each in parts if each is not ...))
        return f"list of {' and '.join(inner)}"
    if origin is dict:
        return f"mapping of {_kind(parts[1])}"
    if isinstance(annotation, type) and issubclass(annotation, Configuration):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return getattr(annotation, "__name__", str(annotation))


def _default(value: Any) -> str:
    if isinstance(value, Configuration):
        return "as below"
    text = json.dumps(value, default=_plain)
    return f"`{text}`" if len(text) <= 60 else "see `--help`"


def _plain(value: Any) -> Any:
    return value.model_dump(mode="json") if isinstance(value, Configuration) else str(value)


def python() -> Iterator[str]:
    names = sorted(name for name in softfin.__all__ if name not in ("testing", "GRID", "SINGLE"))
    found = {name: getattr(softfin, name) for name in names}
    kinds = {name: value for name, value in found.items() if inspect.isclass(value)}
    configurations = [name for name, kind in kinds.items() if issubclass(kind, Configuration)]
    yield from ("## Functions", "")
    for name, function in found.items():
        if inspect.isfunction(function):
            yield from _documented(f"softfin.{name}", function)
    yield from ("## Classes", "")
    for name, kind in kinds.items():
        if name not in configurations:
            yield from _documented(f"softfin.{name}", kind)
            yield from _members(kind)
    yield from (
        "## Configurations",
        "",
        "Their fields are those of [the command line's files](configuration.md): "
        + ", ".join(f"`softfin.{name}`" for name in configurations)
        + "; `softfin.SINGLE` and `softfin.GRID` are the defaults of training.",
        "",
    )
    for name in ("softfin.testing", "softfin.gym"):
        module = importlib.import_module(name)
        yield from (f"## {name}", "", *_text(module))
        # Names that are imported on first use are in dir() from the start.
        for member in dir(module):
            value = getattr(module, member)
            is_own = getattr(value, "__module__", "").startswith(name)
            if is_own and callable(value) and not member.startswith("_"):
                yield from _documented(f"{name}.{member}", value)
                if inspect.isclass(value):
                    yield from _members(value)


def _documented(name: str, value: Any) -> Iterator[str]:
    """A heading, the parameters and the docstring."""
    yield from (f"### {name}", "")
    # Users do not build interfaces.
    if not (inspect.isabstract(value) or getattr(value, "_is_protocol", False)):
        yield from ("```python", _call(name, value), "```", "")
    yield from _text(value)


def _call(name: str, value: Any) -> str:
    """A call with the parameters and their defaults."""
    shown = []
    for parameter in inspect.signature(value).parameters.values():
        bare = parameter.replace(annotation=inspect.Parameter.empty)
        if isinstance(bare.default, Path):
            bare = bare.replace(default=str(bare.default))
        if bare.kind is bare.KEYWORD_ONLY and not any("*" in each for each in shown):
            shown.append("*")
        # Objects have no form that can be typed.
        has_form = bare.default is bare.empty or not repr(bare.default).startswith("<")
        shown.append(str(bare) if has_form else f"{bare.name}=...")
    return "\n".join(textwrap.wrap(f"{name}({', '.join(shown)})", 96, subsequent_indent="    "))


def _text(value: Any) -> Iterator[str]:
    """A docstring as Markdown: its sections are lists, and its examples are code."""
    text = inspect.cleandoc(value.__doc__ or "").replace("``", "`")
    section = ""
    for line in text.splitlines():
        if found := re.fullmatch(
            r"(Args|Returns|Yields|Raises|Attributes|Example|Examples):", line
        ):
            section = found[1]
            yield from ("", f"**{section}**", "")
        elif entry := re.fullmatch(r"    (\*?\w+): (.*)", line):
            yield f"- `{entry[1]}`: {entry[2]}" if section else line
        elif section.startswith("Example") and line.strip():
            yield f"    {line.strip().removeprefix('>>> ').removeprefix('... ')}"
        elif line.startswith("        ") and section:
            yield f"  {line.strip()}"
        else:
            yield line.strip() if section else line
    yield ""


def _members(kind: type) -> Iterator[str]:
    """The fields and methods of a class that have a docstring."""
    for name, text in _field_texts(kind).items():
        yield f"- `{name}`: {text}"
    for name, value in vars(kind).items():
        text = " ".join(inspect.cleandoc(getattr(value, "__doc__", None) or "").split())
        # Named tuples make such a text for their fields.
        if name.startswith("_") or not text or text.startswith("Alias for field"):
            continue
        call = f"{name}()" if inspect.isfunction(value) else name
        yield f"- `{call}`: {text.replace('``', '`')}"
    yield ""


def _field_texts(kind: type) -> dict[str, str]:
    """The strings below the fields of a class."""
    (found,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(found, ast.ClassDef)
    return {
        ast.unparse(field.target): " ".join(text.value.value.split()).replace("``", "`")
        for field, text in pairwise(found.body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


def error_classes() -> Iterator[str]:
    yield from ("| error | exit code | |", "| --- | --- | --- |")
    kinds = [
        kind
        for _, kind in inspect.getmembers(errors, inspect.isclass)
        if issubclass(kind, errors.SoftfinError)
    ]
    for kind in sorted(kinds, key=lambda kind: (len(kind.__mro__), kind.exit_code)):
        base = "" if kind is errors.SoftfinError else f"; a `{kind.__bases__[0].__name__}`"
        yield (
            f"| `{kind.__name__}`{base} | {kind.exit_code} | "
            f"{' '.join((kind.__doc__ or '').split())} |"
        )
    found = messages.messages(Path(softfin.__file__).parent, [kind.__name__ for kind in kinds])
    for name, texts in sorted(found.items()):
        yield from ("", f"## {name}", "", *messages.table(texts))


def evidence() -> Iterator[str]:
    for file in sorted(FOLDER.glob("*.json")):
        record = load(file.stem)
        yield from (
            f"## {record['title']}",
            "",
            # The age would change with every commit; `python -m results --list` prints it.
            f"{re.sub('; ([0-9,]+ commits? old on [0-9-]+|age unknown)', '', source(file.stem, record))}. "
            f"{_versions(record)}",
            "",
        )
        for name in PARTS[file.stem](SEEDS).pictures:
            yield from (f"![{record['title']}]({name.removeprefix('docs/')})", "")
        yield from ("| figure | value | seeds |", "| --- | --- | --- |")
        for name, figure in record["figures"].items():
            value = shown(figure, _form(figure)).replace("|", r"\|")
            unit = figure.get("unit", "")
            # A point between digits stays.
            title = re.sub(r"\.(?!\d)", ": ", name).replace("_", " ")
            yield (
                f"| {title}{f' [{unit}]' if unit and unit not in value else ''} | {value} | "
                f"{_seeds(figure)} |"
            )
        yield ""
        yield from ("```text", *(step["command"] for step in record["steps"].values()), "```", "")


def _form(figure: dict[str, Any]) -> str:
    """Digits for the size of a figure: an angle of half a milliradian, and thousands of
    operations."""
    numbers = np.abs(
        np.array([value for value in figure.get("values", ()) if value is not None], float)
    )
    if not numbers.size:
        return ".3f"
    if (numbers == numbers.round()).all() or numbers.max() >= 1000:
        return ",.0f"
    return ".1f" if numbers.max() >= 10 else ".3f" if numbers.max() >= 0.01 else ".5f"


def _seeds(figure: dict[str, Any]) -> str:
    seeds = figure["seeds"]
    if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _versions(record: dict[str, Any]) -> str:
    # Older files state the version of Python alone, with the machine.
    versions = record.get("versions") or {"python": record["machine"]["python"]}
    return (
        f"{record['machine']['system']}; "
        f"{', '.join(f'{name} {number}' for name, number in versions.items())}."
    )


if __name__ == "__main__":
    write_pages()
    explorer(ROOT / "build" / "extra")
