"""README and docs take their figures from ``results/*.json``: blocks between two comments are written by this module.

    <!-- results: NAME -->
    ...
    <!-- end -->

What stands between them is ``results/blocks/NAME.md``, in which ``{PART.FIGURE}`` is a figure; ``{PART.FIGURE:.2f}``
has other digits than three, and ``{PART.FIGURE:.2f plain}`` another summary (mean, plain for a mean without its
interval, median, worst). Behind a table stands where its figures come from; elsewhere ``{PART}`` puts that phrase.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from results import ROOT
from results.record import load, shown, source

BLOCKS = ROOT / "results" / "blocks"

BLOCK = re.compile(r"(<!-- results: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
PLACE = re.compile(r"\{([a-z][\w-]*)(?:\.([^{}:]+))?(?::(\S+?)(?: (\w+))?)?\}")


def documents() -> list[Path]:
    """README and all docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def names(text: str) -> list[str]:
    """The blocks of a document."""
    return [found[2] for found in BLOCK.finditer(text)]


def filled(text: str, read: Callable[[str], dict[str, Any]] = load) -> str:
    """A document with all of its blocks as the JSON files have them."""
    return BLOCK.sub(lambda found: f"{found[1]}{block(template(found[2]), read)}{found[4]}", text)


def template(name: str) -> str:
    """The text of a block with its places."""
    return (BLOCKS / f"{name}.md").read_text()


def block(text: str, read: Callable[[str], dict[str, Any]] = load) -> str:
    """A block with its places filled, behind a table its sources; raises KeyError for a figure that is not there."""
    sources: dict[str, str] = {}

    def fill(found: re.Match[str]) -> str:
        part, name, form, summary = found.groups()
        record = read(part)
        if name is None:
            return source(part, record)
        if name not in record["figures"]:
            raise KeyError(f"results/{part}.json has no figure {name}; it has {', '.join(record['figures'])}")
        sources[part] = source(part, record)
        return shown(record["figures"][name], form or ".3f", summary)

    done = PLACE.sub(fill, text)
    if not any(line.startswith("|") for line in text.splitlines()):
        return done
    # Files with the same note stand together.
    files: dict[str, list[str]] = {}
    for file, _, note in (each.partition(" ") for each in sources.values()):
        files.setdefault(note, []).append(file)
    told = "; ".join(f"{', '.join(those)} {note}" for note, those in files.items())
    return f"{done}\n*Sources: {told}.*\n"


def differing(read: Callable[[str], dict[str, Any]] = load) -> list[Path]:
    """The documents whose blocks are not as the JSON files have them."""
    return [path for path in documents() if filled(path.read_text(), read) != path.read_text()]


def write() -> list[Path]:
    """Write all blocks anew; returns the documents that this changed."""
    changed = differing()
    for path in changed:
        path.write_text(filled(path.read_text()))
    return changed
