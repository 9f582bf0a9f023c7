"""Pages of the site that are written from softfin itself: command line, configuration, Python,
errors, evidence.

Sphinx runs it before each build (conf.py); what it writes is not kept in git.
"""

import inspect
import json
import re
import tempfile
import types
from collections.abc import Iterator
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


def pages(folder: Path) -> None:
    """Write the parts that pages include, each only where it has changed, so that Sphinx reads no
    page twice."""
    folder.mkdir(exist_ok=True)
    for name, lines in {
        "command-line": command_line(),
        "configuration": configuration(),
        "python": python(),
        "errors": error_classes(),
        "evidence": evidence(),
    }.items():
        file = folder / f"{name}.md"
        text = "\n".join(lines) + "\n"
        if not file.is_file() or file.read_text() != text:
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
        int: "whole number",
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
    stages = [name for name in names if inspect.isfunction(getattr(softfin, name))]
    classes = [name for name in names if inspect.isclass(getattr(softfin, name))]
    configurations = [name for name in classes if issubclass(getattr(softfin, name), Configuration)]
    for title, kind, group in (
        ("Functions", "autofunction", stages),
        ("Classes", "autoclass", [name for name in classes if name not in configurations]),
    ):
        yield from (f"## {title}", "")
        for name in group:
            members = ["   :members:"] if kind == "autoclass" else []
            yield from ("```{eval-rst}", f".. {kind}:: softfin.{name}", *members, "```", "")
    yield from (
        "## Configurations",
        "",
        "Their fields are those of [the command line's files](configuration.md): "
        + ", ".join(f"`softfin.{name}`" for name in configurations)
        + "; `softfin.SINGLE` and `softfin.GRID` are the defaults of training.",
        "",
    )
    for module in ("softfin.testing", "softfin.gym"):
        yield from (
            f"## {module}",
            "",
            "```{eval-rst}",
            f".. automodule:: {module}",
            "   :members:",
            "```",
            "",
        )


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
            f"{source(file.stem, record)}. {_versions(record)}",
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
    pages(ROOT / "docs" / "_generated")
    explorer(ROOT / "build" / "extra")
