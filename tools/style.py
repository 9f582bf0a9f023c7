"""Measures the style of ``src`` by its syntax, which line breaks cannot change; part of ``make
lint``.

Prints each figure and its limit, and exits with 1 if one is exceeded. Figures without a limit are
printed for comparison. Size is the number of syntax nodes, never of lines.
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).parents[1] / "src" / "softfin"

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
SUPERLATIVE = re.compile("(MOST|LEAST|GREATEST|LARGEST|SMALLEST|LONGEST|SHORTEST|FEWEST)_")
LAYOUT = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


class StyleFigure(NamedTuple):
    """One figure, and the most that it may be."""

    name: str
    value: float
    limit: float | None = None


def is_tuple_of_tuple(node: ast.AST) -> bool:
    """Whether an assignment gives several targets several values: each pair deserves a line."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def mentions_any(node: ast.AST) -> bool:
    """Whether an argument or a variable is annotated with `Any`."""
    if not isinstance(node, (ast.arg, ast.AnnAssign)) or node.annotation is None:
        return False
    return any(
        isinstance(inner, ast.Name) and inner.id == "Any" for inner in ast.walk(node.annotation)
    )


def is_superlative(node: ast.AST) -> bool:
    """Whether a constant is called after the most or the least of something: MAX_ and MIN_ do."""
    return (
        isinstance(node, ast.Name)
        and isinstance(node.ctx, ast.Store)
        and SUPERLATIVE.match(node.id) is not None
    )


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the lines of all texts that stand alone."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def count_syntax(tree: ast.Module) -> Iterator[str]:
    """Yield the name of a count for each thing that is counted in a syntax tree."""
    for node in ast.walk(tree):
        yield "nodes"
        if isinstance(node, COMPREHENSIONS):
            yield "comprehensions"
        if is_tuple_of_tuple(node):
            yield "tuples"
        if mentions_any(node):
            yield "any"
        if is_superlative(node):
            yield "superlatives"
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.name.endswith("_of"):
            yield "of"


def count_text(source: str, docstrings: set[int]) -> Counter[str]:
    """Count lines, lines of code and comments; `docstrings` are lines of texts."""
    code_lines: set[int] = set()
    comments = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments += 1
        elif token.type not in LAYOUT:
            code_lines.update(range(token.start[0], token.end[0] + 1))
    return Counter(
        {
            "lines": len(source.splitlines()),
            "code lines": len(code_lines - docstrings),
            "comments": comments,
            "fmt: skip": len(re.findall("# fmt: *skip", source)),
        }
    )


def measure(package: Path = PACKAGE) -> list[StyleFigure]:
    """Return the figures of all modules of a package."""
    counts: Counter[str] = Counter()
    for file in sorted(package.rglob("*.py")):
        source = file.read_text()
        tree = ast.parse(source)
        counts.update(count_syntax(tree))
        counts.update(count_text(source, docstring_lines(tree)))
    thousand_lines = counts["code lines"] / 1000
    return [
        StyleFigure("syntax nodes", counts["nodes"]),
        StyleFigure("nodes per line of code", counts["nodes"] / counts["code lines"]),
        StyleFigure("tuples assigned to tuples", counts["tuples"], 0),
        StyleFigure("fmt: skip", counts["fmt: skip"], 0),
        StyleFigure("constants called MOST_, LEAST_ and the like", counts["superlatives"], 0),
        StyleFigure("functions called *_of", counts["of"], 0),
        StyleFigure("comprehensions per 1,000 lines", counts["comprehensions"] / thousand_lines),
        StyleFigure("annotations with Any", counts["any"]),
        StyleFigure("lines with a comment [%]", 100 * counts["comments"] / counts["lines"]),
    ]


def main() -> int:
    """Print the figures; the exit code."""
    exceeded = False
    for figure in measure():
        bound = "" if figure.limit is None else f"at most {figure.limit:g}"
        sys.stdout.write(f"{figure.name:46} {figure.value:10,.1f}  {bound}\n")
        exceeded |= figure.limit is not None and figure.value > figure.limit
    return int(exceeded)


if __name__ == "__main__":
    sys.exit(main())
