"""Reads CSV and Parquet tables with arbitrary column names as recordings."""

import contextlib
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
from softfin.data.importing.names import CHANNELS, KINDS, OWN_NAMES, SI, UNITS
from softfin.data.importing.text_table import DECIMAL, Table, read_text_table
from softfin.data.issues import Issue
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import CSV

TIME_OF_DAY = r"(?:(?P<hours>\d+):)?(?P<minutes>\d{2}):(?P<seconds>\d{2}(?:[.,:]\d+)?)"
"""Time of day, with or without a date and with or without hours."""

HALF_DAY_S = 43_200.0

MAX_MISSING_SHARE = 0.1
"""Share of missing values above which a table is treated as merged from several sources, each with
its own rows."""


MISSING_TEXTS = r"(?i)^[-+]?(?:|nan.*|null|none|n/?a|-+|1\.#.*|inf.*)$"
"""Texts in place of a missing number."""

GROUPED = r"^[-+]?[1-9]\d{0,2}(?:[.,]\d{3})+$"
"""An integer with thousands separators, unless these are decimal separators."""


def read_table(path: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    """Read the logs in one file; raises LogError if the file is not such a table or a channel is
    missing."""
    is_text = path.suffix.lower() in CSV
    table = read_text_table(path, name) if is_text else _read_parquet(path)
    found = choose_columns(list(dict.fromkeys(table.names)), config, str(path))
    issues = list(table.issues)
    numbers: Channels = {}
    for channel, column in list(found.items()):
        try:
            numbers[channel], found[channel] = _read_column(table, channel, column, path)
        except LogError:
            if channel in CHANNELS:
                raise
            # A text column with the name of an additional channel has a different meaning.
            del found[channel]
        if channel in ANGLES:
            numbers[channel], found_unsigned = _signed(numbers[channel], channel, name)
            issues += found_unsigned
    units = {channel: column.unit for channel, column in found.items()}
    values = converted(numbers, config, units)
    own = [] if is_text else _own_channels(table, found)
    for channel in own:
        values[channel], _ = _read_column(table, channel, Column(channel, "", True), path)
    rows = len(table.columns[0])
    time = values.pop("time") if "time" in found else np.arange(rows) / (config.rate_hz or 1)
    if "command_velocity" not in values and config.velocity_rad_s is not None:
        values["command_velocity"] = np.full(rows, config.velocity_rad_s)
    issues += _notes(name, table.names, found, own, config)
    not_si = {channel: unit for channel, unit in units.items() if unit != SI[KINDS[channel]]}
    whole = Recording(name, part, (Track(time, values),), tuple(issues), not_si)
    return _split_rows(whole, table, config)


def _split_rows(recording: Recording, table: Table, config: ImportConfig) -> list[Recording]:
    """Split a recording into logs, and each log into one track per source."""
    name, _, (whole,), issues, _ = recording
    rows = len(whole.time)
    edges = {*table.starts, *range(0, rows, config.rows_per_log or rows), rows}
    recordings = []
    for start, end in itertools.pairwise(sorted(edges)):
        piece = name if len(edges) == 2 else f"{name} rows {start}..{end - 1}"
        tracks, merged = _tracks(whole.take(slice(start, end)), piece)
        found = (*issues, *merged)
        recordings.append(recording._replace(name=piece, tracks=tracks, issues=found))
        # The notes describe the file, so only the first piece has them.
        issues = ()
    return recordings


def _tracks(table: Track, name: str) -> tuple[tuple[Track, ...], list[Issue]]:
    """Group the channels of a table by the rows in which they have values; in a table merged from
    several sources, each row has values of one source only."""
    groups: dict[bytes, Channels] = {}
    fewest = len(table.time)
    for channel, values in table.channels.items():
        has_value = np.isfinite(values)
        groups.setdefault(has_value.tobytes(), {})[channel] = values
        if channel in CHANNELS:
            fewest = min(fewest, int(has_value.sum()))
    if fewest >= (1 - MAX_MISSING_SHARE) * len(table.time):
        return (table,), []
    tracks = []
    texts = []
    for mask, channels in groups.items():
        track = Track(table.time, channels).take(np.frombuffer(mask, bool))
        tracks.append(track)
        texts.append(f"{', '.join(channels)} in {len(track.time):,}")
    text = f"of {len(table.time):,} rows, {'; '.join(texts)} have values, each at its own times"
    return tuple(tracks), [Issue("note", "merged", name, text)]


def _read_parquet(path: Path) -> Table:
    table = read_parquet(path)
    if not table.num_rows:
        raise NotALogError(f"{path}: the table has no rows; record again")
    names: list[str] = []
    columns: list[pa.ChunkedArray] = []
    for name, column in zip(table.schema.names, table.columns, strict=True):
        parts = [column]
        if isinstance(column.type, (pa.ListType, pa.LargeListType, pa.FixedSizeListType)):
            shortest = pc.min(pc.list_value_length(column)).as_py() or 0
            parts = [pc.list_element(column, index) for index in range(shortest)]
            names += [f"{name}[{index}]" for index in range(shortest)]
        else:
            names.append(name)
        columns += parts
    return Table(names, columns, [0], [])


def _is_numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _read_column(
    table: Table, channel: str, column: Column, path: Path
) -> tuple[Float[np.ndarray, "rows"], Column]:
    """Return the numbers in a column, and the column with the unit of its data type, if there is
    one."""
    if table.names.count(column.name) > 1:
        raise LogError(f"{path}: duplicate column {column.name!r}; rename one of them")
    values = table.columns[table.names.index(column.name)]
    kind = values.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
        number = pa.int32() if pa.types.is_time32(kind) else pa.int64()
        return _floats(values.cast(number)), Column(column.name, kind.unit, True)
    if kind not in (pa.string(), pa.large_string()):
        check_unit(channel, column, str(path))
        try:
            return _floats(values), column
        except pa.ArrowException:
            raise LogError(
                f"{path}: column {column.name!r} has type {kind}, must be numeric; choose another "
                "column or convert it"
            ) from None
    values = pc.utf8_trim_whitespace(values)
    numbers = _parse(values)
    if channel == "time" and not np.isfinite(numbers).any():
        numbers = _parse_clock(values)
        column = Column(column.name, "s", True)
    _check_cells(values, numbers, f"{path}: column {column.name!r}")
    if not np.isfinite(numbers).any():
        raise LogError(
            f"{path}: column {column.name!r} contains no numbers (first {values[0].as_py()!r}); "
            f"choose a different column with --columns {channel}=NAME"
        )
    check_unit(channel, column, str(path))
    return numbers, column


def _check_cells(values: pa.ChunkedArray, numbers: Float[np.ndarray, "rows"], source: str) -> None:
    """Raise LogError if many cells are neither numbers nor missing, or if commas may separate
    thousands."""
    is_other = np.isnan(numbers)
    cells = values.filter(pa.array(is_other))
    is_text = pc.or_(
        pc.match_substring_regex(cells, MISSING_TEXTS),
        pc.invert(pc.match_substring_regex(cells, r"\d")),
    )
    is_number = ~is_other
    is_other[is_other] = ~np.asarray(is_text.fill_null(True))
    has_sign = np.asarray(
        pc.or_(pc.match_substring(values, "."), pc.match_substring(values, ",")).fill_null(False)
    )
    most = MAX_MISSING_SHARE * len(numbers)
    if has_sign.sum() >= 10 and (~has_sign & is_number).any():
        is_grouped = np.asarray(pc.match_substring_regex(values, GROUPED).fill_null(False))
        # Commas or points may separate thousands if each stands before three digits.
        if (has_sign == is_grouped).all():
            is_other = is_grouped
            most = 0
    if is_other.sum() > most:
        cell = values[int(is_other.argmax())].as_py()
        raise LogError(
            f"{source}: {is_other.sum():,} cells are not plain numbers, the first {cell!r}; save "
            "the file without thousands separators or units in the cells"
        )


def _floats(column: pa.ChunkedArray) -> Float[np.ndarray, "rows"]:
    # A safe cast would reject nanoseconds since 1970, which exceed the 53 bits of a double. The
    # rounding error is at most 0.13 us.
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False))


def _parse(column: pa.ChunkedArray) -> Float[np.ndarray, "rows"]:
    """Parse numbers with a decimal point or comma; NaN for any other text."""
    with contextlib.suppress(pa.ArrowInvalid):
        numbers = _floats(column)
        if np.isfinite(numbers).all():
            return numbers
    is_number = pc.match_substring_regex(column, f"^{DECIMAL}$")
    return _floats(pc.if_else(is_number, pc.replace_substring(column, ",", "."), None))


def _parse_clock(column: pa.ChunkedArray) -> Float[np.ndarray, "rows"]:
    """Parse times of day as seconds that continue past midnight and noon."""
    column = pc.replace_substring_regex(column, r"T(\d{2})(\d{2})(\d{2})", r"T\1:\2:\3")
    parts = pc.extract_regex(column, TIME_OF_DAY).flatten()
    hours, minutes, seconds = [_parse(pc.replace_substring(part, ":", ".")) for part in parts]
    times = np.asarray(3600 * np.nan_to_num(hours) + 60 * minutes + seconds)
    # The date is not needed: when it changes, the time goes back by 24 hours, or by 12 with AM and
    # PM. Without hours, the time goes back by one hour at every full hour.
    period = HALF_DAY_S if np.isfinite(hours).any() else 3600
    is_valid = np.isfinite(times)
    times[is_valid] = np.unwrap(times[is_valid], period=period)
    return times


def _signed(
    values: Float[np.ndarray, "rows"], channel: str, name: str
) -> tuple[Float[np.ndarray, "rows"], list[Issue]]:
    """Restore the sign of integers that a drive recorded as unsigned, such as -1 as 65535."""
    finite = values[np.isfinite(values)]
    largest = finite.max(initial=0)
    full = 2.0**16 if largest < 2**16 else 2.0**32
    is_unsigned = finite.min(initial=0) >= 0 and largest < full and not (finite % 1).any()
    if not is_unsigned or np.abs(np.diff(finite)).max(initial=0) < full / 2:
        return values, []
    negative = values >= full / 2
    text = f"{negative.sum():,} values of an unsigned integer are read as negative"
    return values - full * negative, [Issue("note", "unsigned", name, text, column=channel)]


def _own_channels(table: Table, found: dict[str, Column]) -> list[str]:
    """Return the other numeric columns of a log written by softfin."""
    if not set(LOG_COLUMNS) <= set(table.names):
        return []
    # If a column has one of softfin's own names but was not chosen, it is not meant to be read.
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
    """Return notes on the columns and units that were used, unless the names are softfin's own, and
    on unused options and columns."""
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
    if not found["force_x"].is_unit_stated:
        # The unit of a force cannot be inferred from its size, because fins differ in size.
        text = f"column {found['force_x'].name!r} does not state its unit: N is assumed"
        fix = f"state the unit with --force-unit UNIT, one of {', '.join(UNITS['force'])}"
        notes.append(Issue("warning", "force unit", name, text, fix, "force_x"))
    read = {*(column.name for column in found.values()), *own}
    if unused := [column for column in names if column and column not in read]:
        text = f"columns not read: {', '.join(map(repr, unused[:12]))}"
        notes.append(Issue("note", "unread columns", name, text))
    return notes if "velocity" in found else [*notes, derived_velocity(name)]


def derived_velocity(name: str) -> Issue:
    """Return a note that the velocity of a recording was computed from the angle."""
    text = "no velocity column: the velocity is the central difference of the angle"
    return Issue("note", "velocity derived", name, text, column="velocity")
