"""The messages of softfin's errors, as the code raises them; docs/generate.py writes them into the
page of errors."""

import ast
import re
from collections import defaultdict
from collections.abc import Collection, Iterator
from pathlib import Path

GAP = "…"
"""In place of what a message fills in, where the code has no name for it; else the name is there,
in capitals."""

GAPS = re.compile(rf"{GAP}|\b[A-Z][A-Z_]+\b")

LEAST_LETTERS = 8
"""Of a message without its gaps; with fewer it only passes on what something else says."""


def messages(package: Path, kinds: Collection[str]) -> dict[str, list[str]]:
    """List, by the class of error, the texts of all ``raise KIND("...")`` below a folder, sorted,
    each once."""
    found: dict[str, set[str]] = defaultdict(set)
    for file in sorted(package.rglob("*.py")):
        for node in ast.walk(_with_constants(ast.parse(file.read_text()))):
            if (
                isinstance(node, ast.Raise)
                and isinstance(node.exc, ast.Call)
                and isinstance(node.exc.func, ast.Name)
            ):
                name = node.exc.func.id
                arguments = node.exc.args
                if name in kinds and arguments and _letters(_text(arguments[0])) >= LEAST_LETTERS:
                    found[name].add(" ".join(_text(arguments[0]).split()))
    return {
        name: sorted(texts, key=lambda text: GAPS.sub("", text).strip(" :'").lower())
        for name, texts in found.items()
    }


def table(texts: list[str]) -> Iterator[str]:
    """Lines of a table: what a message says, and behind its last semicolon what to do."""
    yield from ("| message | what to do |", "| --- | --- |")
    for text in texts:
        said, semicolon, remedy = text.rpartition("; ")
        if not semicolon or not _letters(said):
            said = text
            remedy = ""
        yield f"| {_escaped(said)} | {_escaped(remedy)} |"


def _with_constants(module: ast.Module) -> ast.Module:
    """Put the texts of a module's constants in place of their names in f-strings."""
    texts = {
        node.targets[0].id: node.value
        for node in module.body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }
    for node in ast.walk(module):
        if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Name):
            node.value = texts.get(node.value.id, node.value)
    return module


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_text, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    if isinstance(node, ast.FormattedValue):
        return _text(node.value) if isinstance(node.value, ast.Constant) else _name(node.value)
    return GAP


def _name(node: ast.expr) -> str:
    """What is filled in, as the code calls it: ``{path}`` and ``{self.path}`` are both PATH."""
    if isinstance(node, ast.Name | ast.Attribute):
        name = (node.id if isinstance(node, ast.Name) else node.attr).strip("_").upper()
        return {"STRERROR": "REASON", "SOURCE": "FILE", "REMEDY": GAP}.get(name, name)
    return GAP


def _letters(text: str) -> int:
    return sum(map(str.isalpha, GAPS.sub("", text)))


def _escaped(text: str) -> str:
    """As Markdown shows it letter for letter."""
    return "".join(f"\\{letter}" if letter in r"\`*_{}[]<>#|$~" else letter for letter in text)
