"""What the documents show: their blocks, the commands in them and in their sentences, their
links."""

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from softfin.cli import COMMANDS

ROOT = Path(__file__).parents[1]
MARKDOWN = (
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").glob("[!_]*/*.md")),
)
GENERATED = "<!-- Below this line, the page is generated"
"""The end of what is written by hand."""
CELL = "code-cell"
"""Kind of a block that the build of the site runs."""
SHOWING = (
    ROOT / "src/softfin/__init__.py",
    *sorted((ROOT / "docs").glob("*.py")),
    *sorted((ROOT / "studies").glob("*.py")),
    *sorted((ROOT / "examples").glob("*.py")),
    *sorted((ROOT / "examples/arduino").glob("*.py")),
)
"""Python files whose first docstring is a document, too."""

PROGRAMS = ("softfin", ".venv/bin/softfin", "python", "make", "pip", "uv")
"""First words of what is a command of this project; others are the system's."""


class Block(NamedTuple):
    """Lines that are shown as they are: fenced, or indented by four spaces behind an empty line."""

    document: str
    line: int
    kind: str
    """What stands behind the fence; empty where it is indented."""
    text: str


class Shown(NamedTuple):
    """A command as a document shows it."""

    document: str
    line: int
    words: tuple[str, ...]
    in_sentence: bool
    """Whether it stands in a sentence, where much may be left out of it."""
    fails: bool = False
    """Whether the document shows that it ends in an error."""
    in_cell: bool = False
    """Whether the build of the site runs it, as it stands."""

    def __str__(self) -> str:
        return f"{self.document}:{self.line} {shlex.join(self.words)}"


def plant_name(path: Path) -> str:
    """As it is called in the repository."""
    return path.relative_to(ROOT).as_posix()


@cache
def text_of(path: Path) -> str:
    """A document as far as it is written by hand; of Python its docstring."""
    if path.suffix != ".py":
        return path.read_text().partition(GENERATED)[0]
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    # The first sentence of a script may show its command between double backquotes.
    return text.replace("``", "`")


@cache
def blocks() -> tuple[Block, ...]:
    """Of all documents."""
    return tuple(block for path in (*MARKDOWN, *SHOWING) for block in _blocks(path))


def _blocks(path: Path) -> Iterator[Block]:
    lines = text_of(path).splitlines()
    at = 0
    while at < len(lines):
        fence = re.match(r"( *)```\{?([\w-]*)", lines[at])
        first = at + 1
        if fence:
            at = next(i for i in range(first, len(lines)) if lines[i].strip() == "```")
            yield Block(plant_name(path), first + 1, fence[2], "\n".join(lines[first:at]))
        elif lines[at].startswith("    ") and (at == 0 or not lines[at - 1].strip()):
            while at < len(lines) and (lines[at].startswith("    ") or not lines[at].strip()):
                at += 1
            yield Block(
                plant_name(path),
                first,
                "",
                "\n".join(line[4:] for line in lines[first - 1 : at]).rstrip(),
            )
            continue
        at += 1


@cache
def spans() -> tuple[tuple[str, int, str], ...]:
    """Of all documents what stands between backquotes in a sentence: document, line, text."""
    return tuple(span for path in (*MARKDOWN, *SHOWING) for span in _spans(path))


def _spans(path: Path) -> Iterator[tuple[str, int, str]]:
    prose = prose_of(path)
    for found in re.finditer(r"`([^`]+)`", prose):
        line = prose.count("\n", 0, found.start()) + 1
        yield plant_name(path), line, " ".join(found[1].replace(r"\|", "|").split())


def prose_of(path: Path) -> str:
    """A document with its blocks blanked out, line by line."""
    lines = text_of(path).splitlines()
    for block in _blocks(path):
        first = block.line - 1
        behind = first + (block.text.count("\n") + 1 if block.text else 0)
        for at in range(first, behind):
            lines[at] = ""
        if block.kind:
            lines[first - 1] = lines[behind] = ""
    return "\n".join(lines)


@cache
def commands() -> tuple[Shown, ...]:
    """All of them, in the order of the documents; those in sentences behind those of their
    document's blocks."""
    found = [shown for block in blocks() for shown in _commands(block)]
    for document, line, text in spans():
        if text.split()[0] in PROGRAMS and " " in text:
            found.append(Shown(document, line, _split(text), True))
    return tuple(found)


def _commands(block: Block) -> Iterator[Shown]:
    lines = block.text.replace("\\\n", "\0").split("\n")
    prompted = any(line.startswith("$ ") for line in lines)
    at = block.line
    for i, line in enumerate(lines):
        text = line.removeprefix("$ ") if prompted else line
        if block.kind == CELL:
            # Its redirections and pipes are the shell's.
            text = re.split(r" (?:\d?>|\|)", text)[0] if "$(" not in text else ""
        first, _, rest = text.partition(" ")
        # What a command says of itself begins with its name and a colon.
        says = rest.split()[:1] and rest.split()[0].endswith(":")
        if first in PROGRAMS and not says and (line.startswith("$ ") or not prompted):
            words = _split(text.replace("\0", " "))
            answer = lines[i + 1] if prompted and i + 1 < len(lines) else ""
            yield Shown(
                block.document,
                at,
                words,
                False,
                answer.startswith(" ".join(words[:2]) + ": "),
                block.kind == CELL,
            )
        at += 1 + line.count("\0")


def _split(text: str) -> tuple[str, ...]:
    return tuple(shlex.split(text, comments=True))


def softfin_words(shown: Shown) -> tuple[str, ...] | None:
    """What the command line of softfin is given; None of another program."""
    words = shown.words[2:] if shown.words[:2] == ("uv", "run") else shown.words
    return words[1:] if words and words[0] in ("softfin", ".venv/bin/softfin") else None


def command_name(words: tuple[str, ...]) -> str:
    """The command, of one word or two, that a line's words begin with."""
    both = " ".join(words[:2])
    return both if both in COMMANDS else words[0]


def headings(path: Path) -> set[str]:
    """Anchors of a document, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", prose_of(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def links(path: Path) -> list[str]:
    """Targets of links and pictures."""
    return re.findall(r"\]\(([^)\s]+)\)", prose_of(path))
