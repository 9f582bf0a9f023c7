"""The messages of softfin's errors, as the code raises them; docs/generate.py writes them into the page of errors."""

import ast
from collections import defaultdict
from collections.abc import Collection, Iterator
from pathlib import Path

GAP = "…"
"""In place of what a message fills in: a file, a value, the values that are allowed."""

LEAST_LETTERS = 8
"""Of a message without its gaps; with fewer it only passes on what something else says."""


def messages(package: Path, kinds: Collection[str]) -> dict[str, list[str]]:
    """List, by the class of error, the texts of all ``raise KIND("...")`` below a folder, sorted, each once."""
    found: dict[str, set[str]] = defaultdict(set)
    for file in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
                name, arguments = node.exc.func.id, node.exc.args
                if name in kinds and arguments and sum(map(str.isalpha, text := _text(arguments[0]))) >= LEAST_LETTERS:
                    found[name].add(" ".join(text.split()))
    return {name: sorted(texts, key=lambda text: text.strip(f"{GAP}:' ").lower()) for name, texts in found.items()}


def table(texts: list[str]) -> Iterator[str]:
    """Lines of a table: what a message says, and behind its last semicolon what to do."""
    yield from ("| message | what to do |", "| --- | --- |")
    for text in texts:
        said, semicolon, remedy = text.rpartition("; ")
        if not semicolon or sum(map(str.isalpha, said)) < LEAST_LETTERS:
            said, remedy = text, ""
        yield f"| {_escaped(said)} | {_escaped(remedy)} |"


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_text, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    return GAP


def _escaped(text: str) -> str:
    """As Markdown shows it letter for letter."""
    return "".join(f"\\{letter}" if letter in r"\`*_{}[]<>#|$~" else letter for letter in text)
