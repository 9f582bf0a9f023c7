"""Reads tables, CSV or Parquet, with any column names: files go in, recordings come out."""

import csv
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float

from softfin.core.errors import LogError, one_line
from softfin.data.importing.clocks import Part, Recording, Track
from softfin.data.importing.columns import Column, choose_columns, converted, describe_columns
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import Issue
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import CSV


def read_table(path: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    """Read the logs of one file; raises LogError for a file that is not such a table or lacks a
    channel."""
    if path.suffix.lower() in CSV:
        names, delimiter = _read_header(path)
        found = choose_columns(names, config, str(path))
        table = _read_csv(path, names, delimiter, [column.name for column in found.values()])
    else:
        table = read_parquet(path)
        names = table.schema.names
        found = choose_columns(names, config, str(path))
    rows = table.num_rows
    if not rows:
        raise LogError(f"{path}: empty: it has no rows; record it again")
    numbers = {}
    units = {}
    for channel, column in found.items():
        numbers[channel] = _numbers(table.column(column.name), column.name, path)
        units[channel] = column.unit
    values = converted(numbers, config, units)
    time = values.pop("time") if "time" in found else np.arange(rows) / (config.rate_hz or 1)
    if "command_velocity" not in values and config.velocity_rad_s is not None:
        values["command_velocity"] = np.full(rows, config.velocity_rad_s)
    whole = Track(time, values)
    issues = tuple(_notes(name, names, found, config))
    length = config.rows_per_log or rows
    if length >= rows:
        return [Recording(name, part, (whole,), issues)]
    recordings = []
    for start in range(0, rows, length):
        end = min(start + length, rows)
        piece = whole.take(slice(start, end))
        recordings.append(Recording(f"{name} rows {start}..{end - 1}", part, (piece,), issues))
        # Only once, with the first piece.
        issues = ()
    return recordings


def _notes(
    name: str, names: list[str], found: dict[str, Column], config: ImportConfig
) -> list[Issue]:
    """Describe which column was used for which channel, and its unit, unless softfin's own names
    state it."""
    texts = []
    fix = ""
    if described := describe_columns(found):
        texts.append(described)
        fix = (
            "if that is wrong: --columns CHANNEL=NAME (- for none), --angles, --force-unit, "
            "--time-unit"
        )
    options = {
        "command_velocity": (config.velocity_rad_s, "--velocity"),
        "time": (config.rate_hz, "--rate"),
    }
    for channel, (value, option) in options.items():
        if value is not None and channel in found:
            texts.append(f"{option} {value:g} not used: {found[channel].name!r} holds it")
    if config.velocity_rad_s is not None and "command_velocity" not in found:
        texts.append(
            f"command_velocity = {config.velocity_rad_s:g} rad/s throughout, from --velocity"
        )
    notes = [Issue("note", "columns", name, "; ".join(texts), fix)] if texts else []
    read = {column.name for column in found.values()}
    if unused := [column for column in names if column not in read]:
        text = f"columns that were not read: {', '.join(map(repr, unused[:12]))}"
        notes.append(Issue("note", "unread columns", name, text))
    return notes if "velocity" in found else [*notes, derived_velocity(name)]


def derived_velocity(name: str) -> Issue:
    """Note that a recording has no velocity."""
    text = "no velocity: it is the central difference of the angle"
    return Issue("note", "velocity derived", name, text, column="velocity")


def _read_header(path: Path) -> tuple[list[str], str]:
    """Return the column names of a CSV file, and its delimiter."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            line = file.readline()
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as text ({error}); give a CSV file") from None
    if not line.strip():
        raise LogError(f"{path}: empty: it has no header; the first line must name the columns")
    delimiter = max(",;\t", key=line.count)
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]
    if all(re.fullmatch(r"[-+.eE\d]*\d[-+.eE\d]*", name) for name in names):
        raise LogError(
            f"{path}: its first line holds numbers ({line.strip()[:60]}); write the columns' names "
            "above it"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise LogError(f"{path}: column {twice[0]!r} is there twice; rename one of them")
    return names, delimiter


def _read_csv(path: Path, names: list[str], delimiter: str, columns: list[str]) -> pa.Table:
    try:
        return pyarrow.csv.read_csv(
            path,
            read_options=pyarrow.csv.ReadOptions(column_names=names, skip_rows=1),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=columns,
                column_types=dict.fromkeys(columns, pa.float64()),
                null_values=["", "nan", "NaN", "NAN", "NA", "N/A", "null", "None", "-"],
            ),
        )
    except (pa.ArrowException, OSError) as error:
        reason = one_line(error)
        raise LogError(
            f"{path}: not a table of numbers ({reason}); correct that line, or leave it empty"
        ) from None


def _numbers(column: pa.ChunkedArray, name: str, path: Path) -> Float[np.ndarray, "rows"]:
    try:
        # Unsafe, since nanoseconds since 1970 have more digits than a double: that leaves a quarter
        # of a microsecond.
        return np.asarray(column.cast(pa.float64(), safe=False).to_numpy())
    except pa.ArrowException:
        raise LogError(
            f"{path}: column {name!r} is {column.type}, must hold numbers; choose "
            "another, or convert it"
        ) from None
