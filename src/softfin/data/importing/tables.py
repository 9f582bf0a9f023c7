"""Read CSV and Parquet tables with arbitrary column names as recordings."""

import itertools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from softfin.core.errors import LogError, NotALogError
from softfin.core.log_channels import LOG_COLUMNS
from softfin.data.importing.clocks import Channels, Part, Recording, Track
from softfin.data.importing.columns import (
    Column,
    check_unit,
    choose_columns,
    converted,
    describe_columns,
)
from softfin.data.importing.importing import ANGLES, ImportConfig
from softfin.data.importing.names import CHANNELS, FURTHER, OWN_NAMES
from softfin.data.importing.text_table import NUMBER, Table, read_text_table
from softfin.data.issues import Issue, counted
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import CSV

CLOCK = (
    r"(?:(?P<hours>\d+):)?(?P<minutes>\d{1,2}):(?P<seconds>\d{1,2}(?:[.,:]\d+)?)"
    r"\s*(?P<half>[AaPp][Mm])?"
)
"""Time of day, of which the hours may be missing."""

DAY_S = 86_400.0

SPARSE = 0.1
"""Share of missing values from which a table is taken for one of several sources, each with its own
rows."""

MIN_UNIX_S = 1e9
"""Unix time of the year 2001 [s]; larger values must be in a smaller unit than the year 2286."""

Numbers = Float[np.ndarray, "rows"]


def read_table(path: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    """Read the logs in one file; raises LogError if it is not such a table or if a channel is
    missing."""
    is_text = path.suffix.lower() in CSV
    table = read_text_table(path, name) if is_text else _read_parquet(path)
    found = choose_columns(list(dict.fromkeys(table.names)), config, str(path))
    for channel in FURTHER:
        # A column of text with the name of a further channel is some other thing.
        if channel in found and not _is_usable(table, found[channel]):
            del found[channel]
    own = [] if is_text else _own_channels(table, found)
    issues = list(table.issues)
    numbers: Channels = {}
    for channel in [*found, *own]:
        column = found.get(channel, Column(channel, "", True))
        numbers[channel], is_clock = _read_column(table, channel, column, path)
        if is_clock:
            found[channel] = Column(column.name, "s", True)
        elif channel == "time":
            check_unit(channel, column, str(path))
            found[channel] = _with_unix_unit(column, numbers[channel])
        elif channel in ANGLES:
            numbers[channel], negative = _signed(numbers[channel])
            if negative:
                text = f"{negative:,} values of an unsigned integer are read as negative"
                issues.append(Issue("note", "unsigned", name, text, column=channel))
    units = {channel: column.unit for channel, column in found.items()}
    rows = len(table.columns[0])
    values = converted({channel: numbers[channel] for channel in found}, config, units)
    values |= {channel: numbers[channel] for channel in own}
    time = values.pop("time") if "time" in found else np.arange(rows) / (config.rate_hz or 1)
    if "command_velocity" not in values and config.velocity_rad_s is not None:
        values["command_velocity"] = np.full(rows, config.velocity_rad_s)
    issues += _notes(name, table.names, found, own, config)
    edges = {*table.starts, *range(0, rows, config.rows_per_log or rows), rows}
    recordings = []
    for start, end in itertools.pairwise(sorted(edges)):
        title = name if len(edges) == 2 else f"{name} rows {start}..{end - 1}"
        piece, dropped = _without_empty_rows(Track(time, values).take(slice(start, end)), title)
        if len(piece.time):
            tracks, merged = _tracks(piece, title)
            recordings.append(Recording(title, part, tracks, (*issues, *dropped, *merged)))
            # The issues describe the file, so only its first piece has them.
            issues = []
    return recordings


def _read_parquet(path: Path) -> Table:
    table = read_parquet(path)
    names = []
    columns = []
    for name, column in zip(table.schema.names, table.columns, strict=True):
        if _is_list(column.type):
            # Lists of one length become one column per element.
            lengths = pc.list_value_length(column)
            for index in range(pc.min(lengths).as_py() or 0):
                names.append(f"{name}[{index}]")
                columns.append(pc.list_element(column, index))
        else:
            names.append(name)
            columns.append(column)
    if not table.num_rows:
        raise NotALogError(f"{path}: the table has no rows; record again")
    return Table(names, columns, [0], [])


def _is_list(kind: pa.DataType) -> bool:
    tests = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(test(kind) for test in tests)


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _is_usable(table: Table, column: Column) -> bool:
    """Whether a column contains numbers."""
    values = table.columns[table.names.index(column.name)]
    if _is_text(values.type):
        return bool(np.isfinite(_parse(values)).any())
    return _is_numeric(values.type)


def _is_numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _read_column(table: Table, channel: str, column: Column, path: Path) -> tuple[Numbers, bool]:
    """Return the numbers in a column, and whether they are times of day, in seconds."""
    if table.names.count(column.name) > 1:
        raise LogError(f"{path}: duplicate column {column.name!r}; rename one of them")
    values = table.columns[table.names.index(column.name)]
    kind = values.type
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
        values = values.cast(kind)
    if pa.types.is_timestamp(kind) or pa.types.is_time(kind) or pa.types.is_duration(kind):
        per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]
        stamps = values.cast(pa.int32() if pa.types.is_time32(kind) else pa.int64())
        return _floats(stamps) / per_second, channel == "time"
    if not _is_text(kind):
        try:
            return _floats(values), False
        except pa.ArrowException:
            raise LogError(
                f"{path}: column {column.name!r} has type {kind}, must be numeric; choose another "
                "column or convert it"
            ) from None
    numbers = _parse(values)
    if np.isfinite(numbers).any():
        return numbers, False
    if channel == "time" and (times := _parse_clock(values)) is not None:
        return times, True
    shown = next((text for text in values.to_pylist() if text), "")
    raise LogError(
        f"{path}: column {column.name!r} contains no numbers (first value {shown!r}); choose "
        f"another column with --columns {channel}=NAME"
    )


def _floats(column: pa.ChunkedArray) -> Numbers:
    # A safe cast would reject nanoseconds since 1970, which exceed the 53 bits of a double. The
    # rounding error is at most 0.13 us.
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy())


def _parse(column: pa.ChunkedArray) -> Numbers:
    """Parse numbers with a decimal point or comma; NaN for any other text."""
    text = pc.replace_substring(column, ",", ".")
    is_number = pc.match_substring_regex(text, f"^{NUMBER}$")
    return _floats(pc.if_else(is_number, text, None).cast(pa.float64()))


def _parse_clock(column: pa.ChunkedArray) -> Numbers | None:
    """Parse times of day, with or without a date, as seconds that continue past midnight."""
    parts = pc.extract_regex(column, CLOCK).combine_chunks()
    hours = _parse(parts.field("hours"))
    minutes = _parse(parts.field("minutes"))
    seconds = _parse(pc.replace_substring(parts.field("seconds"), ":", "."))
    half = np.asarray(pc.utf8_lower(parts.field("half")).to_numpy(zero_copy_only=False))
    hours = np.where(half == "", hours, hours % 12) + 12 * (half == "pm")
    times: Numbers = 3600 * np.nan_to_num(hours) + 60 * minutes + seconds
    is_valid = np.isfinite(times)
    if not is_valid.any():
        return None
    # The date is not needed: at midnight, the time of day goes back by a day.
    times[is_valid] = np.unwrap(times[is_valid], period=DAY_S)
    return times


def _with_unix_unit(column: Column, time: Numbers) -> Column:
    """Return the column with the unit that a time since 1970 shows by its size."""
    typical = float(np.nanmedian(time))
    for unit, per_second in {"ms": 1e3, "us": 1e6, "ns": 1e9}.items():
        is_in_unit = MIN_UNIX_S * per_second <= typical < 1e3 * MIN_UNIX_S * per_second
        if is_in_unit and not column.is_unit_stated:
            return column._replace(unit=unit)
    return column


def _signed(values: Numbers) -> tuple[Numbers, int]:
    """Return integers with their sign, and the number of those that were recorded without it, as 16
    or 32 bits: -1 as 65535, e.g. by a drive that turns past 0."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.min() < 0 or (finite != np.round(finite)).any():
        return values, 0
    for bits in (16, 32):
        full = 2.0**bits
        is_negative = values >= full / 2
        passes_zero = np.abs(np.diff(finite)).max(initial=0) > full / 2
        if passes_zero and finite.max() < full:
            return values - full * is_negative, int(is_negative.sum())
    return values, 0


def _without_empty_rows(table: Track, name: str) -> tuple[Track, list[Issue]]:
    """Drop rows without any number, such as lines of text."""
    series = list(table.channels.values())
    has_value = np.isfinite(series).any(axis=0)
    # Without a column for it, every row has a time.
    has_value |= np.isfinite(table.time) & ~np.isfinite(table.time).all()
    empty = np.flatnonzero(~has_value)
    if not empty.size:
        return table, []
    text = f"{counted(empty.size, 'row')} without any number dropped"
    fix = "check whether other text was written to the file"
    issue = Issue("warning", "dropped rows", name, text, fix, row=int(empty[0]))
    return table.take(has_value), [issue]


def _tracks(table: Track, name: str) -> tuple[tuple[Track, ...], list[Issue]]:
    """Group the channels of a table by the rows in which they have values.

    Tables that are merged from several sources have rows with the values of one source only.
    """
    has_time = np.isfinite(table.time)
    counts = {}
    groups: dict[bytes, Channels] = {}
    for channel, values in table.channels.items():
        has_value = np.isfinite(values) & has_time
        counts[channel] = int(has_value.sum())
        groups.setdefault(has_value.tobytes(), {})[channel] = values
    needed = [counts[channel] for channel in counts if channel in CHANNELS]
    if min(needed) >= (1 - SPARSE) * has_time.sum():
        return (table,), []
    tracks = []
    for mask, channels in groups.items():
        rows = np.frombuffer(mask, bool)
        if rows.any() or channels.keys() & set(CHANNELS):
            tracks.append(Track(table.time, channels).take(rows))
    listed = ", ".join(f"{channel} in {count:,}" for channel, count in counts.items())
    text = f"of {len(table.time):,} rows, {listed} have values; each channel keeps its own times"
    return tuple(tracks), [Issue("note", "merged", name, text)]


def _own_channels(table: Table, found: dict[str, Column]) -> list[str]:
    """Return the other numeric columns of softfin's own log."""
    if not set(LOG_COLUMNS) <= set(table.names):
        return []
    # A column with a name of softfin's own that was not found is not meant to be read.
    settled = {*(column.name for column in found.values()), *OWN_NAMES, *CHANNELS}
    own = []
    for name, column in zip(table.names, table.columns, strict=True):
        if name not in settled and _is_numeric(column.type):
            own.append(name)
    return own


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
    if unused := [column for column in names if column and column not in read]:
        text = f"columns not read: {', '.join(map(repr, unused[:12]))}"
        notes.append(Issue("note", "unread columns", name, text))
    return notes if "velocity" in found else [*notes, derived_velocity(name)]


def derived_velocity(name: str) -> Issue:
    """Return the note that a recording has no velocity."""
    text = "no velocity column: the velocity is the central difference of the angle"
    return Issue("note", "velocity derived", name, text, column="velocity")
