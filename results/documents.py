"""README and docs take their figures from ``results/*.json``: this module writes the blocks between
two comments.

    <!-- results: NAME -->
    ...
    <!-- end -->

``results/blocks/NAME.md`` is the template of the block. In it ``{PART.FIGURE}`` is a figure,
``{PART.FIGURE:.2f}`` has other digits than three and ``{PART.FIGURE:.2f plain}`` another summary
(mean, plain for a mean without its interval, median, worst). ``{PART.FIGURE?}`` may be newer than
the JSON file; the document then says that it is not yet measured. A line below a table names the
files, seeds and dates of its figures; elsewhere ``{PART}`` does so. The evidence page of the site
adds commands, commits, machine and age.
"""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from results import ROOT
from results.record import load, short_source, shown

BLOCKS = ROOT / "results" / "blocks"

BLOCK = re.compile(r"(<!-- results: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
PLACE = re.compile(r"\{([a-z][\w-]*)(?:\.([^{}:?]+)(\?)?)?(?::(\S+?)(?: (\w+))?)?\}")

DEFAULT_FORM = ".3f"

NOT_MEASURED = "not yet measured"


def documents() -> list[Path]:
    """Return the paths of README and all docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/[!_]*.md"))]


def names(text: str) -> list[str]:
    """Return the names of the blocks of a document."""
    return [found[2] for found in BLOCK.finditer(text)]


def filled(text: str, read: Callable[[str], dict[str, Any]] = load) -> str:
    """Return a document with all of its blocks as the JSON files have them."""
    return BLOCK.sub(lambda found: f"{found[1]}{block(template(found[2]), read)}{found[4]}", text)


def template(name: str) -> str:
    """Return the template of a block."""
    return (BLOCKS / f"{name}.md").read_text()


def block(text: str, read: Callable[[str], dict[str, Any]] = load) -> str:
    """Fill a template and add the sources below a table; raises KeyError for an unknown figure."""
    records: dict[str, dict[str, Any]] = {}

    def fill(found: re.Match[str]) -> str:
        part, name, is_new, form, summary = found.groups()
        record = read(part)
        if name is None:
            return short_source(part, record)
        if is_new and name not in record["figures"]:
            return NOT_MEASURED
        if name not in record["figures"]:
            raise KeyError(
                f"results/{part}.json has no figure {name}; it has {', '.join(record['figures'])}"
            )
        records[part] = record
        return shown(record["figures"][name], form or DEFAULT_FORM, summary)

    filled_text = PLACE.sub(fill, text)
    has_table = any(line.startswith("|") for line in text.splitlines())
    if not has_table:
        return filled_text
    # Files with the same note share it.
    files: dict[str, list[str]] = {}
    for part, record in records.items():
        file, _, note = short_source(part, record).partition(" ")
        files.setdefault(note, []).append(file)
    joined = "; ".join(
        f"{', '.join(names_of_files)} {note}" for note, names_of_files in files.items()
    )
    return f"{filled_text}\n*Sources: {joined}.*\n"


def printed_digits() -> dict[tuple[str, str], float]:
    """Return the last digit that a document prints of each (part, figure), such as 0.001; the
    finest of several."""
    digits: dict[tuple[str, str], float] = {}
    for path in sorted(BLOCKS.glob("*.md")):
        for part, name, _, form, _ in PLACE.findall(path.read_text()):
            digits[part, name] = min(
                last_digit(form or DEFAULT_FORM), digits.get((part, name), math.inf)
            )
    return digits


def last_digit(form: str) -> float:
    """Return the value of the last digit that a format such as ``.3f`` prints."""
    found = re.search(r"\.(\d+)", form)
    return 10.0 ** -int(found[1]) if found else 1.0


def differing(read: Callable[[str], dict[str, Any]] = load) -> list[Path]:
    """Return the documents whose blocks differ from the JSON files."""
    return [path for path in documents() if filled(path.read_text(), read) != path.read_text()]


def write() -> list[Path]:
    """Write all blocks; return the documents that this changed."""
    changed = []
    for path in documents():
        text = path.read_text()
        filled_text = filled(text)
        if filled_text != text:
            path.write_text(filled_text)
            changed.append(path)
    return changed
