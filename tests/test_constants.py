"""A constant has one value: two modules that give a name different values mean two things, which
need two names."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from tests.documents import ROOT

PACKAGE = ROOT / "src" / "softfin"


def constants(path: Path) -> Iterator[tuple[str, str]]:
    """Names and values, as source, of a module's public constants."""
    for statement in ast.parse(path.read_text()).body:
        if isinstance(statement, ast.Assign):
            targets = statement.targets
        elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
            targets = [statement.target]
        else:
            continue
        for target in targets:
            for name, value in pairs(target, statement.value):
                if name.isupper() and not name.startswith("_"):
                    yield name, ast.unparse(value)


def pairs(target: ast.expr, value: ast.expr) -> list[tuple[str, ast.expr]]:
    if isinstance(target, ast.Name):
        return [(target.id, value)]
    if isinstance(target, ast.Tuple):
        # What is unpacked from a call counts as a whole for each name.
        values = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
        return [
            pair for each, its in zip(target.elts, values, strict=True) for pair in pairs(each, its)
        ]
    return []


def test_constants_of_one_name_have_one_value() -> None:
    places: defaultdict[str, defaultdict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted(PACKAGE.rglob("*.py")):
        for name, value in constants(path):
            places[name][value].append(str(path.relative_to(PACKAGE)))
    assert len(places) > 500
    assert {name: dict(values) for name, values in places.items() if len(values) > 1} == {}
