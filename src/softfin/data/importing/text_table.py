"""Read the columns of a text file as text: finds its encoding, header, units and delimiter.

The header is the line whose width fits the most numbers below it, so lines before it are ignored.
Lines of another width are dropped and counted.
"""

import codecs
import csv
import re
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from softfin.core.errors import LogError, NotALogError, one_line
from softfin.core.printable import printable
from softfin.data.importing.names import OWN_NAMES, SPELLED, read_name
from softfin.data.issues import Issue, counted

DELIMITERS = (",", ";", "\t", " ")

NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"

HEAD_BYTES = 100_000
"""Size of the beginning of a file in which the header is looked for."""

BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}

MAX_SHOWN_CHARACTERS = 60
"""Maximum length of a line in a message."""


class Table(NamedTuple):
    """Columns as read from a file, before any conversion."""

    names: list[str]
    columns: list[pa.ChunkedArray]
    starts: list[int]
    """First row of each log: 0, and the rows below each repeated header."""
    issues: list[Issue]


class _Layout(NamedTuple):
    """Position and form of the header of a text file."""

    delimiter: str
    names: list[str]
    """Names of the columns, with the units of a line below them."""
    cells: list[str]
    """First and second cell of the header as in the file."""
    first: int
    """Index of the first line below the header and its units."""
    numbers: int
    """Number of cells with numbers that fit this layout."""


def read_text_table(path: Path, name: str) -> Table:
    """Read a text file; raises LogError if it has no header or no rows."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    data = _to_utf8(data)
    # A power cut leaves NUL bytes in place of the last lines.
    num_nul = data.count(0)
    if num_nul:
        data = re.sub(rb"\0+", b"\n", data)
    layout, body = _find_layout(data, path)
    columns, dropped = _read_columns(body, layout, path)
    texts = []
    if num_nul:
        texts.append(f"{num_nul:,} NUL bytes ignored")
    if dropped:
        row, text = dropped[0]
        shown = printable(text, most=MAX_SHOWN_CHARACTERS)
        texts.append(
            f"{counted(len(dropped), 'line')} without {len(layout.names)} cells dropped, the first "
            f"is row {row}: {shown!r}"
        )
    issues = []
    if texts:
        fix = "check the end of the recording, or whether other text was written to the file"
        issues.append(Issue("warning", "dropped rows", name, "; ".join(texts), fix))
    is_header = pc.and_(*map(pc.equal, columns, [cell.strip() for cell in layout.cells]))
    starts = [0]
    for number, row in enumerate(pc.indices_nonzero(is_header).to_pylist()):
        # The headers above it are removed.
        starts.append(row - number)
    is_row = pc.invert(is_header)
    names = [column.strip() for column in layout.names]
    return Table(names, [column.filter(is_row) for column in columns], starts, issues)


def _to_utf8(data: bytes) -> bytes:
    for mark, encoding in BYTE_ORDER_MARKS.items():
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, "replace").encode()
    head = data[:1000]
    # The text of a log is mostly ASCII, so every second byte of UTF-16 is 0.
    for start, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if head[start::2].count(0) > 0.9 * len(head) / 2 > 0 and head[1 - start :: 2].count(0) == 0:
            return data.decode(encoding, "replace").encode()
    # A single damaged byte further down does not change the encoding.
    lines = data[:HEAD_BYTES].rpartition(b"\n")[0] or data
    try:
        lines.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace").encode()
    return data.decode("utf-8", "replace").encode()


def _find_layout(data: bytes, path: Path) -> tuple[_Layout, bytes]:
    """Return the layout, and the lines below the header."""
    head = data[:HEAD_BYTES].decode("utf-8", "replace")
    lines = re.split(r"\r\n|\n|\r", head)
    layouts = [_layout(lines, delimiter) for delimiter in DELIMITERS]
    layout = max(layouts, key=lambda one: one.numbers)
    if not layout.names or not layout.numbers:
        _check_header(lines, path)
        first = next(index for index, line in enumerate(lines) if line.strip())
        delimiter = max(DELIMITERS[:3], key=lines[first].count)
        cells = _cells(lines[first], delimiter)
        layout = _Layout(delimiter, cells, cells[:2], first + 1, 0)
    above = re.match(rb"(?:[^\r\n]*(?:\r\n|\n|\r|\Z)){%d}" % layout.first, data)
    return layout, data[above.end() :] if above else b""


def _check_header(lines: list[str], path: Path) -> None:
    first = next((line.strip() for line in lines if line.strip()), None)
    if first is None:
        raise NotALogError(f"{path}: no header; the first line must contain the column names")
    for delimiter in DELIMITERS:
        cells = _cells(first, delimiter)
        if all(map(_is_number, cells)):
            raise LogError(
                f"{path}: no header: the first line contains numbers ({first[:60]}); add a line "
                "with the column names above it"
            )


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])


def _is_number(cell: str) -> bool:
    return re.fullmatch(NUMBER, cell.strip().replace(",", ".")) is not None


def _layout(lines: list[str], delimiter: str) -> _Layout:
    """Return the layout with the most numbers for a delimiter."""
    best = _Layout(delimiter, [], [], 0, 0)
    rows = []
    for line in lines:
        cells = _cells(line, delimiter) if line.strip() else []
        rows.append((cells, sum(map(_is_number, cells))))
    # Number of cells with numbers in this line and below, by the width of their row.
    numbers: dict[int, int] = {}
    is_above_numbers = False
    for index in range(len(rows) - 1, -1, -1):
        cells, count = rows[index]
        if not cells:
            continue
        numbers[len(cells)] = numbers.get(len(cells), 0) + count
        if not count and is_above_numbers:
            for width, fitting in numbers.items():
                if width > 1 and fitting > best.numbers:
                    names, header = _header(lines, rows[: index + 1], width, delimiter)
                    if names:
                        best = _Layout(delimiter, names, header[:2], index + 1, fitting)
        is_above_numbers = count > 0
    return best


def _header(
    lines: list[str], rows: list[tuple[list[str], int]], width: int, delimiter: str
) -> tuple[list[str], list[str]]:
    """Return the names from the lines directly above the first row of numbers, and the cells they
    are from; empty if none of these lines has that width."""
    candidates: list[list[str]] = []
    for index in range(len(rows) - 1, -1, -1):
        cells, count = rows[index]
        if count or not cells:
            break
        if delimiter == " ":
            cells = _spaced_names(lines[index], width)
        # A delimiter at the end of the lines is in the header, or in the rows, or in both.
        while len(cells) > width and not cells[-1].strip():
            cells = cells[:-1]
        if len(cells) == width - 1:
            cells = [*cells, ""]
        if len(cells) == width:
            candidates.insert(0, cells)
    if not candidates:
        return [], []
    cells = max(candidates, key=_num_recognized)
    names = [cells[0].lstrip("#; ").removeprefix("% "), *cells[1:]]
    for units in candidates[candidates.index(cells) + 1 :]:
        if any(map(_is_unit, units)):
            names = [_with_unit(*pair) for pair in zip(names, units, strict=True)]
            break
    return names, cells


def _spaced_names(line: str, width: int) -> list[str]:
    """Split names at spaces; a space may also separate a name from its unit."""
    text = line.strip().removeprefix("#").strip()
    for separator in (r"\s+", r"\s{2,}|\t", r"\s+(?![\[({])"):
        names = re.split(separator, text)
        if len(names) == width:
            return names
    return []


def _num_recognized(names: list[str]) -> int:
    return sum(name in OWN_NAMES or read_name(name) is not None for name in names)


def _is_unit(cell: str) -> bool:
    word = cell.strip().strip("[](){}<>").lower()
    return any(word in spelled for spelled in SPELLED.values())


def _with_unit(name: str, unit: str) -> str:
    unit = unit.strip().strip("[](){}<>")
    return f"{name.strip()} [{unit}]" if unit else name


def _read_columns(
    body: bytes, layout: _Layout, path: Path
) -> tuple[list[pa.ChunkedArray], list[tuple[int, str]]]:
    """Return the columns, and row and text of each line that was dropped."""
    dropped = []

    def drop(row: pyarrow.csv.InvalidRow) -> str:
        # Comments are not rows.
        if row.text.strip() and not row.text.lstrip().startswith(("#", "%", "//")):
            dropped.append((row.number - 1, row.text))
        return "skip"

    if layout.delimiter == " ":
        body = re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", body)
        body = re.sub(rb"[ \t]+", b" ", body)
    if not body.strip():
        raise NotALogError(f"{path}: the table has no rows; record again")
    names = [str(number) for number in range(len(layout.names))]
    try:
        table = pyarrow.csv.read_csv(
            pa.BufferReader(body),
            read_options=pyarrow.csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=pyarrow.csv.ParseOptions(
                delimiter=layout.delimiter,
                # A stray quote in a file without quotes would join all lines below it.
                quote_char='"' if b'"' in body[:HEAD_BYTES] else False,
                invalid_row_handler=drop,
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string())
            ),
        )
    except pa.ArrowException as error:
        raise NotALogError(
            f"{path}: not a table ({one_line(error)}); use a CSV file with one line per row"
        ) from None
    if not table.num_rows:
        row, text = dropped[0] if dropped else (0, "")
        shown = printable(text, most=MAX_SHOWN_CHARACTERS)
        raise NotALogError(
            f"{path}: no row has the {len(names)} cells of the header; row {row} is {shown!r}"
        )
    return [pc.utf8_trim_whitespace(column) for column in table.columns], dropped
