"""Reads the columns of a text file as text, after finding its encoding, header, units and
delimiter.

Lines above the header are ignored. Lines below the header with a different number of cells are
dropped and counted.
"""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from softfin.core.errors import LogError, NotALogError, one_line
from softfin.core.printable import printable
from softfin.data.importing.names import OWN_NAMES, SPELLED, read_name
from softfin.data.issues import Issue, counted, row_severity

DELIMITERS = (",", ";", "\t", "|", " ")

DECIMAL = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?"

HEAD_BYTES = 100_000
"""Number of bytes at the start of a file that are searched for the header."""

MIN_COLUMNS = 4
"""Minimum width of a header: a log without times has command, angle and force (x, y)."""

COMMENT = re.compile(r"\s*(#|%|//|\"?sep=|$)", re.IGNORECASE)

UNICODE_ENCODINGS = {"13": "utf-16-le", "02": "utf-16-be", "123": "utf-32-le", "012": "utf-32-be"}
"""Encodings by the places of four bytes that are often NUL."""


class Table(NamedTuple):
    """Columns read from a file, before any conversion."""

    names: list[str]
    columns: list[pa.ChunkedArray]
    starts: list[int]
    """First row of each log: 0 and the row below each repeated header."""
    issues: list[Issue]


class _Layout(NamedTuple):
    """Layout of a text file."""

    delimiter: str
    header: list[str]
    """Cells of the header."""
    units: list[str]
    """Cells of the line with the units; empty if there is no such line."""
    num_above: int
    """Number of lines above the first row."""
    num_numbers: int
    """Number of cells with numbers in the first row."""


def read_text_table(path: Path, name: str) -> Table:
    """Read a text file; raises NotALogError if it has no header or no rows."""
    try:
        body = _to_utf8(path.read_bytes())
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    # After a power cut, the last lines may be NUL bytes. A search is faster than a substitution.
    if b"\0" in body:
        body = re.sub(rb"\0+", b"\nNUL bytes\n", body)
    body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    layout = _find_layout(body[:HEAD_BYTES].decode("utf-8", "replace"), path)
    body = re.sub(rb"(?:.*\n){%d}" % layout.num_above, b"", body, count=1)
    cut = b""
    if _is_cut(body):
        body, _, cut = body.rpartition(b"\n")
    columns, dropped = _read_columns(body, layout, path)
    if cut:
        dropped.append((len(columns[0]), cut.decode("utf-8", "replace")))
    issues = []
    if dropped:
        row, line = dropped[0]
        num_lines = sum(text.count("\n") + 1 for _, text in dropped)
        message = (
            f"{counted(num_lines, 'line')} without {len(columns)} complete cells dropped, the "
            f"first at row {row}: {printable(line, most=60)!r}"
        )
        fix = "check the end of the recording, or whether other text was written to the file"
        severity = row_severity(num_lines, len(columns[0]))
        issues.append(Issue(severity, "dropped rows", name, message, fix, row=row))
    is_header = _equals(columns, layout.header)
    is_row = pc.invert(is_header)
    if layout.units:
        is_row = pc.and_(is_row, pc.invert(_equals(columns, layout.units)))
    starts = [0]
    # Remove headers and units between the rows.
    if not pc.all(is_row).as_py():
        rows_above = np.cumsum(is_row.to_numpy())
        starts += rows_above[np.asarray(is_header)].tolist()
        columns = [column.filter(is_row) for column in columns]
    names = [layout.header[0].lstrip("#; "), *layout.header[1:]]
    for index, unit in enumerate(layout.units):
        if unit := unit.strip(" []()"):
            names[index] += f" [{unit}]"
    return Table([name.strip() for name in names], columns, starts, issues)


def _equals(columns: list[pa.ChunkedArray], cells: list[str]) -> pa.ChunkedArray:
    """Return whether the first cells of each row are equal to the given cells."""
    first = map(pc.utf8_trim_whitespace, columns[:2])
    return pc.and_(*map(pc.equal, first, [cell.strip() for cell in cells[:2]]))


def _to_utf8(data: bytes) -> bytes:
    """Decode any encoding, and encode as UTF-8 without a byte order mark."""
    if data.startswith(bytes(4)):
        data = data.lstrip(b"\0")
    # The NUL bytes of digits and delimiters are at the same position within each character.
    is_nul = np.frombuffer(data[:4000], np.uint8) == 0
    places = "".join(
        str(place) for place in range(4) if 3 * is_nul[place::4].sum() > len(is_nul) / 4
    )
    try:
        text = data.decode(UNICODE_ENCODINGS.get(places, "utf-8"))
    except UnicodeDecodeError:
        # The degree sign of old Macs.
        text = data.decode("cp1252", "replace").replace("¡", "°")
    return text.removeprefix("\ufeff").encode()


def _is_cut(body: bytes) -> bool:
    """Return whether the last line ends within a number: it has fewer digits than the lines above,
    which all have the same number."""
    lines = body[-1000:].split(b"\n")[-9:]
    *above, last = [len(re.split(b"[.,]", line)[-1]) for line in lines]
    return 0 < last < min(above, default=0) == max(above, default=0)


def _find_layout(head: str, path: Path) -> _Layout:
    """Return the layout with the most numbers; raises an error if there is no header."""
    lines = head.split("\n")
    layouts = filter(None, (_layout(lines, delimiter) for delimiter in DELIMITERS))
    best = max(layouts, key=lambda layout: layout.num_numbers, default=None)
    if best is not None:
        return best
    first = next(filter(str.strip, lines), "").strip()
    if any(all(map(_is_number, _cells(first, delimiter))) for delimiter in DELIMITERS) and first:
        raise LogError(
            f"{path}: no header: the first line contains numbers ({first[:60]}); add a line with "
            "the column names above it"
        )
    raise NotALogError(
        f"{path}: no rows of numbers below a header with the names of at least {MIN_COLUMNS} "
        "columns; use a file that contains a log"
    )


def _layout(lines: list[str], delimiter: str) -> _Layout | None:
    """Return the layout for a delimiter: a header above the first row of numbers, with the same
    number of cells."""
    above: list[list[str]] = []
    num_above = 0
    for index, line in enumerate(lines):
        cells = _cells(line, delimiter)
        num_numbers = sum(map(_is_number, cells))
        if not num_numbers:
            above.append(cells)
            num_above = index + 1
            continue
        width = len(cells)
        # A delimiter may end the rows, the header or both.
        padded = [[*names, ""] for names in above if len(names) >= max(MIN_COLUMNS, width) - 1]
        fitting = [names[:width] for names in padded if not any(names[width:])]
        if fitting:
            fitting.reverse()
            header = max(fitting, key=_name_score)
            fitting.remove(header)
            units = next((row for row in fitting if sum(map(_is_unit, row)) > 1), [])
            return _Layout(delimiter, header, units, num_above, num_numbers)
    return None


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter != " ":
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    if any(map(_is_number, line.split())):
        return line.split()
    # In a header, a space may also separate a name from its unit.
    line = line.strip().lstrip("#% ")
    return re.split(r"\s{2,}|\t" if "  " in line.strip() else r"\s+(?![\[({])", line)


def _is_number(cell: str) -> bool:
    return re.fullmatch(DECIMAL, cell.strip()) is not None


def _name_score(cells: list[str]) -> int:
    """Return the number of cells that are channel names, minus the number of cells that are
    units."""
    num_names = sum(cell in OWN_NAMES or read_name(cell) is not None for cell in cells)
    return num_names - sum(map(_is_unit, cells))


def _is_unit(cell: str) -> bool:
    word = cell.strip(" []()").lower()
    return any(word in spelled for spelled in SPELLED.values())


def _read_columns(
    body: bytes, layout: _Layout, path: Path
) -> tuple[list[pa.ChunkedArray], list[tuple[int, str]]]:
    """Return the columns, and the row and text of each dropped line."""
    dropped = []

    def drop(row: pyarrow.csv.InvalidRow) -> str:
        if not COMMENT.match(row.text):
            dropped.append((row.number - 1, row.text))
        return "skip"

    if layout.delimiter == " ":
        body = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", body))
    names = [str(number) for number in range(len(layout.header))]
    # A stray quote in a file without quotes would join all lines below it.
    quote = '"' if b'"' in "".join(layout.header).encode() + body[:1000] else False
    try:
        table = pyarrow.csv.read_csv(
            pa.BufferReader(body),
            read_options=pyarrow.csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=pyarrow.csv.ParseOptions(
                delimiter=layout.delimiter, quote_char=quote, invalid_row_handler=drop
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string())
            ),
        )
    except pa.ArrowException as error:
        raise LogError(
            f"{path}: not a table ({one_line(error)}); use a CSV file with one line per row"
        ) from None
    return table.columns, dropped
