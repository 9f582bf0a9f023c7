"""Reference forces from a file: a CSV or Parquet table with ``time_s``, ``force_x_n`` and ``force_y_n``; others unread.

Each row is asked from its time on until the next one. Logs of softfin have these columns too; their times begin one
tick after the start, at 0.01 s: a first row up to one tick late is asked from 0 on.
"""

import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import TICK_S
from softfin.data.importing.names import SPELLED, UNITS
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import check_reference_file
from softfin.task.signals import CLOCK_S, Recorded

COLUMNS = {
    "time_s": ("s", "seconds", "time"),
    "force_x_n": ("n", "newton", "force"),
    "force_y_n": ("n", "newton", "force"),
}
"""Columns that are read: the unit that the name ends in, its word, and the quantity."""

LONGEST_S = 3600.0
"""Longest reference that is followed [s]; a longer one is in another unit."""

MOST_ROWS = 360_000
"""An hour at 100 Hz, the rate of readings."""

Rows = list[tuple[str, tuple[float, ...]]]
"""Where each row stands, in words, and its values in the order of `COLUMNS`."""


def read_reference_file(path: Path) -> Recorded:
    """The reference over time; raises ConfigurationError naming the line, what is wrong with it and the way out."""
    check_reference_file(path)
    rows = _read_csv(path) if path.suffix == ".csv" else _read_parquet(path)
    if not rows:
        raise _error(path, "empty: no rows; give at least one, at time_s = 0")
    _check(path, rows)
    times = (0.0, *(values[0] for _, values in rows[1:]))
    recorded = Recorded(time_s=times, force_n=tuple((values[1], values[2]) for _, values in rows))
    if recorded.seconds > LONGEST_S:
        raise _error(
            path,
            f"{rows[-1][0]}: time_s = {times[-1]:g} makes {recorded.seconds} s; at most {LONGEST_S:g} s are followed: "
            "are these milliseconds? Then divide them by 1000; else cut the file",
        )
    return recorded


def _error(path: Path, message: str) -> ConfigurationError:
    return ConfigurationError(f"--reference-file {path}: {message}")


def _read_csv(path: Path) -> Rows:
    rows: Rows = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.reader(file)
            header = [name.strip() for name in next(table, [])]
            places = _places(path, header)
            for fields in table:
                if any(field.strip() for field in fields):
                    where = f"line {table.line_num}"
                    _check_count(path, len(rows) + 1)
                    rows.append((where, tuple(_number(path, where, header, fields, place) for place in places)))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _error(path, f"cannot be read ({error}); give a CSV file") from None
    return rows


def _check_count(path: Path, rows: int) -> None:
    if rows > MOST_ROWS:
        raise _error(path, f"has {rows:,} rows or more; at most {MOST_ROWS:,} are followed; leave rows out")


def _number(path: Path, where: str, header: list[str], fields: list[str], place: int) -> float:
    text = fields[place].strip() if place < len(fields) else ""
    try:
        return float(text)
    except ValueError:
        raise _error(
            path,
            f"{where}, column {header[place]}: {text!r} is not a number; write one, or leave the whole line out",
        ) from None


def _read_parquet(path: Path) -> Rows:
    try:
        table = read_parquet(path)
        header: list[str] = table.schema.names
        names = [header[place] for place in _places(path, header)]
        _check_count(path, table.num_rows)
        columns = [table.column(name).cast(pa.float64()).to_numpy().tolist() for name in names]
    except (LogError, pa.ArrowException) as error:
        raise _error(path, f"not a Parquet table of numbers ({' '.join(str(error).split())}); write it again") from None
    return [(f"row {k}", values) for k, values in enumerate(zip(*columns, strict=True))]


def _places(path: Path, header: list[str]) -> list[int]:
    """Where the columns stand; raises ConfigurationError for one that is missing, or given in another unit."""
    if not any(header):
        raise _error(path, f"empty: no header; the first line must be {','.join(COLUMNS)}")
    for name, (unit, word, kind) in COLUMNS.items():
        if header.count(name) == 1:
            continue
        if name in header:
            raise _error(path, f"column {name} is there twice; take one of them out")
        quantity = name.removesuffix(f"_{unit}")
        other = next((met for met in header if met.lower() == quantity or met.lower().startswith(f"{quantity}_")), None)
        if other is None:
            raise _error(path, f"no column {name} among {', '.join(header)}; it needs {','.join(COLUMNS)}")
        met = SPELLED[kind].get(other.lower().removeprefix(f"{quantity}_"))
        change = f"{f'multiply it by {UNITS[kind][met]:.7g}' if met else f'give it in {word}'} and name it {name}"
        raise _error(path, f"column {other} is not in {word}, which is needed; {change}")
    return [header.index(name) for name in COLUMNS]


def _check(path: Path, rows: Rows) -> None:
    for where, values in rows:
        for name, value in zip(COLUMNS, values, strict=True):
            if not np.isfinite(value):
                raise _error(
                    path,
                    f"{where}, column {name}: {value:g} is not finite; leave that row out, and the force before it is "
                    "held",
                )
    first = rows[0][1][0]
    if not -CLOCK_S <= first <= TICK_S + CLOCK_S:
        raise _error(
            path,
            f"{rows[0][0]}: time_s begins at {first:g}; begin at 0: subtract {first:g} from all times, or add a row "
            "at 0",
        )
    for (_, before), (where, after) in pairwise(rows):
        if after[0] <= before[0]:
            raise _error(
                path,
                f"{where}: time_s = {after[0]:g} after {before[0]:g}; times must grow: sort the rows, one for each "
                "time",
            )
