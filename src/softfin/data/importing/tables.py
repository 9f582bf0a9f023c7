"""Tables on disk, CSV or Parquet with any column names: files in, recordings out."""

import csv
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.core.files import regular_file
from softfin.data.checks.findings import Finding, Place
from softfin.data.importing.columns import OWN_NAMES, Column, choose_columns, converted, shown
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import KINDS, UNITS
from softfin.data.importing.recording import Part, Recording, Track
from softfin.storage.parquet_file import MOST_BYTES, check_names, check_rows, damaged, open_parquet
from softfin.storage.paths import CSV

LONGEST_HEADER = 100_000
"""Letters of the line that names the columns."""

MANY_ROWS = 100_000
"""A single log of more than this, a quarter of an hour, is more likely several end to end."""


def read_table(path: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    """The logs of one file; raises LogError for a file that is no such table or lacks a channel."""
    names = _csv_names(path) if path.suffix.lower() in CSV else _parquet_names(path)
    found = choose_columns(names, config, str(path))
    columns = [column.name for column in found.values()]
    table = (_read_csv if path.suffix.lower() in CSV else _read_parquet)(path, names, columns)
    values = {channel: _numbers(table.column(column.name), column.name, path) for channel, column in found.items()}
    if not table.num_rows:
        raise LogError(f"{path}: empty: it has no rows; record it again")
    values = converted(values, config, {channel: column.unit for channel, column in found.items()})
    time = values.pop("time") if "time" in found else np.arange(table.num_rows) / (config.rate_hz or 1)
    if "command_velocity" not in values and config.velocity_rad_s is not None:
        values["command_velocity"] = np.full(table.num_rows, config.velocity_rad_s)
    track = Track(time, values)
    findings = _notes(name, names, found, table.num_rows, config)
    time_unit = found["time"].unit if "time" in found else "s"
    length = config.rows_per_log or table.num_rows
    if length >= table.num_rows:
        return [Recording(name, part, (track,), findings, time_unit)]
    return [
        Recording(
            f"{name} rows {start}..{min(start + length, table.num_rows) - 1}",
            part,
            (_cut(track, start, length),),
            () if start else findings,
            time_unit,
        )
        for start in range(0, table.num_rows, length)
    ]


def _cut(track: Track, start: int, length: int) -> Track:
    rows = slice(start, start + length)
    return Track(track.time[rows], {channel: values[rows] for channel, values in track.channels.items()})


def _notes(
    name: str, names: list[str], found: dict[str, Column], rows: int, config: ImportConfig
) -> tuple[Finding, ...]:
    notes = _columns_shown(name, found, config)
    timed = "time" in found
    read = {column.name for column in found.values()}
    if unused := [column for column in names if column not in read]:
        text = f"columns that were not read: {', '.join(map(repr, unused[:12]))}"
        notes.append(Finding("note", "unread columns", Place(name), text, alike=repr(unused)))
    if "velocity" not in found:
        text = "no velocity: it is the central difference of the angle"
        notes.append(Finding("note", "velocity derived", Place(name, "velocity"), text))
    if rows > MANY_ROWS and not timed and config.rows_per_log is None:
        text = f"{rows:,} rows without a column of time, taken as one log"
        way_out = "if it is several end to end, as the paper's 20,000 rows each: --rows-per-log 20000"
        notes.append(Finding("warning", "one log", Place(name), text, way_out))
    return tuple(notes)


def _columns_shown(name: str, found: dict[str, Column], config: ImportConfig) -> list[Finding]:
    """Which column was taken for what, in which unit and why, wherever softfin's own names do not say so."""
    findings = []
    text = shown(found)
    if config.velocity_rad_s is not None:
        told = f"command_velocity = {config.velocity_rad_s:g} rad/s throughout, by --velocity"
        if "command_velocity" in found:
            told = f"--velocity {config.velocity_rad_s:g} not used: {found['command_velocity'].name!r} holds it"
        text = "; ".join(filter(None, [text, told]))
    if config.rate_hz is not None and "time" in found:
        told = f"--rate {config.rate_hz:g} not used: {found['time'].name!r} holds the time"
        text = "; ".join(filter(None, [text, told]))
    if text:
        way_out = "if that is wrong: --columns CHANNEL=NAME (- for none), --angles, --force-unit, --time-unit"
        foreign = any(OWN_NAMES.get(column.name) != channel for channel, column in found.items())
        findings.append(Finding("note", "columns", Place(name), text, way_out if foreign else "", alike=text))
    for channel, column in found.items():
        if column.unclear:
            sentence = f"{column.unclear!r} in its name {column.name!r} is no known unit; taken as {column.unit}"
            units = ", ".join(UNITS[KINDS[channel]])
            way_out = f"known are {units}: say it by --angles, --force-unit or --time-unit, or convert the column"
            findings.append(Finding("warning", "unknown unit", Place(name, channel), sentence, way_out))
    return findings


def _csv_names(path: Path) -> list[str]:
    try:
        with regular_file(path, MOST_BYTES).open(encoding="utf-8-sig") as file:
            line = file.readline(LONGEST_HEADER + 1)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}); give a CSV file") from None
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: cannot be read as text ({error}); give a CSV file") from None
    if len(line) > LONGEST_HEADER:
        raise LogError(f"{path}: its first line has over {LONGEST_HEADER:,} letters; it must name the columns")
    if not line.strip():
        raise LogError(f"{path}: empty: it has no header; the first line must name the columns")
    names = [name.strip() for name in next(csv.reader([line], delimiter=_delimiter(line)))]
    if all(_is_number(name) for name in names):
        raise LogError(f"{path}: its first line holds numbers ({line.strip()[:60]}); write the columns' names above it")
    check_names(path, names)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise LogError(f"{path}: column {twice!r} is there twice; rename one of them")
    return names


def _delimiter(line: str) -> str:
    return max(",;\t", key=line.count)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_csv(path: Path, names: list[str], columns: list[str]) -> pa.Table:
    with path.open(encoding="utf-8-sig") as file:
        delimiter = _delimiter(file.readline())
    empty = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "None", "-"]
    batches, rows = [], 0
    try:
        reader = pyarrow.csv.open_csv(
            path,
            read_options=pyarrow.csv.ReadOptions(column_names=names, skip_rows=1),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=columns, column_types=dict.fromkeys(columns, pa.float64()), null_values=empty
            ),
        )
        with reader:
            # A file does not say how many rows it has: they are counted as they come.
            for batch in reader:
                rows += batch.num_rows
                check_rows(path, rows)
                batches.append(batch)
            return pa.Table.from_batches(batches, reader.schema)
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())[:500]
        raise LogError(f"{path}: not a table of numbers ({reason}); correct that line, or leave it empty") from None


def _parquet_names(path: Path) -> list[str]:
    with open_parquet(path) as file:
        names: list[str] = file.schema_arrow.names
    return names


def _read_parquet(path: Path, names: list[str], columns: list[str]) -> pa.Table:
    try:
        with open_parquet(path) as file:
            return file.read(columns)
    except (pa.ArrowException, OSError) as error:
        raise damaged(path, error) from None


def _numbers(column: pa.ChunkedArray, name: str, path: Path) -> Float[np.ndarray, "rows"]:
    try:
        # Unsafe, since nanoseconds since 1970 have more digits than a double: that leaves a quarter of a microsecond.
        return np.asarray(column.cast(pa.float64(), safe=False).to_numpy())
    except pa.ArrowException:
        raise LogError(
            f"{path}: column {name!r} is {column.type}, must hold numbers; map another, or cast it"
        ) from None
