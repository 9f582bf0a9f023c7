"""Read CSV and Parquet tables with arbitrary column names as recordings."""

import csv
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float

from softfin.core.errors import LogError, one_line
from softfin.core.log_channels import LOG_COLUMNS
from softfin.data.importing.clocks import Part, Recording, Track
from softfin.data.importing.columns import (
    OWN_NAMES,
    Column,
    choose_columns,
    converted,
    describe_columns,
)
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import CHANNELS, FURTHER
from softfin.data.issues import Issue
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import CSV


def read_table(path: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    """Read the logs in one file; raises LogError if it is not such a table or if a channel is
    missing."""
    if path.suffix.lower() in CSV:
        names, delimiter = _read_header(path)
        found = choose_columns(names, config, str(path))
        needed = [column.name for channel, column in found.items() if channel not in FURTHER]
        further = [column.name for channel, column in found.items() if channel in FURTHER]
        table = _read_csv(path, names, delimiter, needed, further)
    else:
        table = read_parquet(path)
        names = table.schema.names
        _check_duplicates(names, path)
        found = choose_columns(names, config, str(path))
    rows = table.num_rows
    if not rows:
        raise LogError(f"{path}: the table has no rows; record again")
    for channel in FURTHER:
        # A column of text with the name of a further channel is some other thing.
        if channel in found and not _is_numeric(table.column(found[channel].name).type):
            del found[channel]
    numbers = {}
    units = {}
    for channel, column in found.items():
        numbers[channel] = _numbers(table.column(column.name), column.name, path)
        units[channel] = column.unit
    values = converted(numbers, config, units)
    time = values.pop("time") if "time" in found else np.arange(rows) / (config.rate_hz or 1)
    if "command_velocity" not in values and config.velocity_rad_s is not None:
        values["command_velocity"] = np.full(rows, config.velocity_rad_s)
    own = [] if path.suffix.lower() in CSV else _own_channels(table.schema, found)
    for channel in own:
        values[channel] = _numbers(table.column(channel), channel, path)
    whole = Track(time, values)
    recording = Recording(name, part, (whole,), tuple(_notes(name, names, found, own, config)))
    return _split_rows(recording, config.rows_per_log or rows)


def _split_rows(recording: Recording, length: int) -> list[Recording]:
    """Split a recording of one track into pieces with `length` rows."""
    name, part, (whole,), issues = recording
    rows = len(whole.time)
    if length >= rows:
        return [recording]
    recordings = []
    for start in range(0, rows, length):
        end = min(start + length, rows)
        piece = whole.take(slice(start, end))
        recordings.append(Recording(f"{name} rows {start}..{end - 1}", part, (piece,), issues))
        # The notes describe the file, so only its first piece has them.
        issues = ()
    return recordings


def _own_channels(schema: pa.Schema, found: dict[str, Column]) -> list[str]:
    """Return the other numeric columns of softfin's own log."""
    if not set(LOG_COLUMNS) <= set(schema.names):
        return []
    # A column with a name of softfin's own that was not found is not meant to be read.
    settled = {*(column.name for column in found.values()), *OWN_NAMES, *CHANNELS}
    return [field.name for field in schema if field.name not in settled and _is_numeric(field.type)]


def _notes(
    name: str,
    names: list[str],
    found: dict[str, Column],
    own: list[str],
    config: ImportConfig,
) -> list[Issue]:
    """Note which columns and units were used, unless the names are softfin's own, and which options
    and columns were not used."""
    texts = []
    fix = ""
    if described := describe_columns(found):
        texts.append(described)
        fix = (
            "if this is wrong, use --columns CHANNEL=NAME (- for none), --angles, --force-unit or "
            "--time-unit"
        )
    options = {
        "command_velocity": (config.velocity_rad_s, "--velocity"),
        "time": (config.rate_hz, "--rate"),
    }
    for channel, (value, option) in options.items():
        if value is not None and channel in found:
            texts.append(f"{option} {value:g} ignored: the file has column {found[channel].name!r}")
    if config.velocity_rad_s is not None and "command_velocity" not in found:
        texts.append(
            f"command_velocity = {config.velocity_rad_s:g} rad/s everywhere, from --velocity"
        )
    notes = [Issue("note", "columns", name, "; ".join(texts), fix)] if texts else []
    read = {*(column.name for column in found.values()), *own}
    if unused := [column for column in names if column not in read]:
        text = f"columns not read: {', '.join(map(repr, unused[:12]))}"
        notes.append(Issue("note", "unread columns", name, text))
    return notes if "velocity" in found else [*notes, derived_velocity(name)]


def derived_velocity(name: str) -> Issue:
    """Return the note that a recording has no velocity."""
    text = "no velocity column: the velocity is the central difference of the angle"
    return Issue("note", "velocity derived", name, text, column="velocity")


def _read_header(path: Path) -> tuple[list[str], str]:
    """Return the column names and the delimiter of a CSV file."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            line = file.readline()
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as text ({error}); use a CSV file") from None
    if not line.strip():
        raise LogError(f"{path}: no header; the first line must contain the column names")
    delimiter = max(",;\t", key=line.count)
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]
    number = re.compile(r"[-+.eE\d]*\d[-+.eE\d]*")
    if all(map(number.fullmatch, names)):
        raise LogError(
            f"{path}: no header: the first line contains numbers ({line.strip()[:60]}); add a line "
            "with the column names above it"
        )
    _check_duplicates(names, path)
    return names, delimiter


def _check_duplicates(names: list[str], path: Path) -> None:
    if twice := [name for name in names if names.count(name) > 1]:
        raise LogError(f"{path}: duplicate column {twice[0]!r}; rename one of them")


def _read_csv(
    path: Path, names: list[str], delimiter: str, needed: list[str], further: list[str]
) -> pa.Table:
    """Read the columns; those in `needed` must contain numbers."""
    try:
        return pyarrow.csv.read_csv(
            path,
            read_options=pyarrow.csv.ReadOptions(column_names=names, skip_rows=1),
            parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=list(dict.fromkeys([*needed, *further])),
                column_types=dict.fromkeys(needed, pa.float64()),
                null_values=["", "nan", "NaN", "NAN", "NA", "N/A", "null", "None", "-"],
            ),
        )
    except (pa.ArrowException, OSError) as error:
        reason = one_line(error)
        raise LogError(
            f"{path}: not a table of numbers ({reason}); correct that value or leave it empty"
        ) from None


def _is_numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _numbers(column: pa.ChunkedArray, name: str, path: Path) -> Float[np.ndarray, "rows"]:
    try:
        # A safe cast would reject nanoseconds since 1970, which exceed the 53 bits of a double. The
        # rounding error is at most 0.13 us.
        return np.asarray(column.cast(pa.float64(), safe=False).to_numpy())
    except pa.ArrowException:
        raise LogError(
            f"{path}: column {name!r} has type {column.type}, must be numeric; choose a different "
            "column or convert it"
        ) from None
