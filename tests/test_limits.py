"""The limits and defaults of every configuration are those of `limits.txt`: a change of one shows in
its difference. Write it anew with ``SOFTFIN_WRITE_LIMITS=1 pytest tests/test_limits.py``."""

import importlib
import os
from collections.abc import Iterator
from pathlib import Path

from softfin.core.configuration import Configuration

TABLE = Path(__file__).with_name("limits.txt")
SOURCE = Path(__file__).parents[1] / "src"
DESCRIBED = ("title", "description", "$ref", "type")


def configurations(base: type[Configuration] = Configuration) -> Iterator[type[Configuration]]:
    for each in base.__subclasses__():
        yield each
        yield from configurations(each)


def limits(schema: object) -> object:
    """A schema without its descriptions and without defaults that are configurations, which have
    lines of their own."""
    if isinstance(schema, list):
        return [limits(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        name: limits(value)
        for name, value in schema.items()
        if name not in DESCRIBED and not (name == "default" and isinstance(value, dict))
    }


def table() -> list[str]:
    modules = []
    for file in (SOURCE / "softfin").rglob("*.py"):
        if "Field(" in file.read_text():
            modules.append(".".join(file.relative_to(SOURCE).with_suffix("").parts))
            importlib.import_module(modules[-1])
    lines = set()
    for each in configurations():
        if each.__module__ in modules:
            fields = each.model_json_schema().get("properties", {})
            name = f"{each.__module__}.{each.__name__}"
            lines |= {f"{name} {field}: {limits(value)}" for field, value in fields.items()}
    return sorted(line for line in lines if not line.endswith(": {}"))


def test_the_limits_and_defaults_are_those_of_the_table() -> None:
    lines = table()
    if "SOFTFIN_WRITE_LIMITS" in os.environ:
        TABLE.write_text("\n".join([*lines, ""]))
    assert lines == TABLE.read_text().splitlines()
