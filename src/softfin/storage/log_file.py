"""A log as a Parquet file: seven named columns and any further channels, fully checked on writing
and reading.

A Log is read back exactly as written. A log that cannot be used for training raises a LogError that
gives the location and the cause.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from softfin.core.errors import LogError, one_line
from softfin.core.log_channels import LOG_COLUMNS
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.storage import artifact as artifacts
from softfin.storage.formats import FILES, IN_FILE, check_file_format

# float64: a float32 cannot resolve 10 ms after 36 hours, nor Unix time (1.7e9 s) at all.
SCHEMA = pa.schema(
    [pa.field(name, pa.float64() if name == "time_s" else pa.float32()) for name in LOG_COLUMNS],
    metadata={IN_FILE: str(FILES["log"])},
)

RATE_TOLERANCE = 0.01
"""Largest allowed relative error of the mean rate."""

Columns = dict[str, NDArray[np.floating]]


def write_log(path: Path, log: Log) -> None:
    """Write a log; raises LogError and writes nothing if `read_log` would reject it."""
    artifacts.write_file(path, encode_log(log, str(path)))


def encode_log(log: Log, source: str) -> bytes:
    """Return a log as the bytes of a Parquet file; raises LogError, naming `source`, if `read_log`
    would reject it."""
    # Transformations by JAX sort a dictionary, so the order is always alphabetical.
    names = sorted(log.channels)
    if taken := [name for name in names if name in SCHEMA.names]:
        raise LogError(f"{source}: channel {taken[0]} is a column of every log; rename it")
    schema = SCHEMA
    for name in names:
        schema = schema.append(pa.field(name, pa.float32()))
    values = (log.reading.time, *log.columns, *(log.channels[name] for name in names))
    columns = {}
    for field, column in zip(schema, values, strict=True):
        columns[field.name] = np.asarray(column, field.type.to_pandas_dtype())
    check_columns(columns, source)
    sink = pa.BufferOutputStream()
    pq.write_table(
        pa.table(columns, schema=schema), sink, compression="zstd", write_page_checksum=True
    )
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_log(path: Path) -> Log:
    """Read a log as NumPy arrays; raises LogError with the file, row, column, value and fix.

    Columns that a log need not have become its channels.
    """
    table = read_parquet(path)
    names = table.schema.names
    problems = [(name, "is missing") for name in SCHEMA.names if name not in names]
    problems += [(name, "is repeated") for name in names if names.count(name) > 1]
    if problems:
        column, problem = problems[0]
        raise LogError(
            f"{path}: column {column!r} {problem}; the file has {names}; a log must have "
            f"{', '.join(SCHEMA.names)}"
        )
    columns = {}
    for name, kind in zip(SCHEMA.names, SCHEMA.types, strict=True):
        values = table.column(name)
        if values.type != kind:
            raise LogError(f"{path}: column {name} is {values.type}, but must be {kind}; cast it")
        columns[name] = values.to_numpy()
    channels = {}
    for name in sorted(set(names) - set(SCHEMA.names)):
        channels[name] = _to_channel(table.column(name), name, path)
    check_columns(columns | channels, str(path))
    time, command_angle, command_velocity, angle, velocity, *force = columns.values()
    return Log(
        Command(command_angle, command_velocity),
        Reading(time, angle, velocity, np.stack(force, axis=1)),
        channels,
    )


def _to_channel(column: pa.ChunkedArray, name: str, path: Path) -> NDArray[np.float32]:
    try:
        # Unlike the columns of every log, these may come from any program, in any numeric type.
        return np.asarray(column.cast(pa.float32(), safe=False).to_numpy())
    except pa.ArrowException:
        raise LogError(
            f"{path}: column {name} is {column.type}, but must be float; remove it"
        ) from None


def check_columns(columns: Columns, source: str) -> None:
    """Raise LogError unless the columns have rows, finite values and a steady 100 Hz clock."""
    if not columns["time_s"].size:
        raise LogError(f"{source}: has no rows; record it again")
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise LogError(
                f"{source}: row {bad[0]}, column {name}: {values[bad[0]]} ({_count(bad.size)} in "
                "this column); remove these rows, or split the log around them"
            )
    time = columns["time_s"]
    # The order of the checks matters: a repeated or wrong time would also look like a wrong rate or
    # a gap.
    steps = np.diff(time)
    backward = np.flatnonzero(steps <= 0)
    if backward.size:
        row = backward[0] + 1
        raise LogError(
            f"{source}: row {row}, column time_s: {time[row]:.4f} s repeats or precedes row "
            f"{row - 1} ({time[row - 1]:.4f} s); remove repeated rows and sort by time_s"
        )
    if not steps.size:
        return
    uneven = np.flatnonzero(np.abs(steps - TICK_S) > 0.5 * TICK_S)
    # Use the mean rate over at least a second without gaps, otherwise the median: at a wrong rate,
    # every step looks like a gap.
    is_steady = not uneven.size and steps.size >= RATE_HZ
    rate = steps.size / float(time[-1] - time[0]) if is_steady else 1 / float(np.median(steps))
    low, high = (1 - RATE_TOLERANCE, 1 + RATE_TOLERANCE) if is_steady else (2 / 3, 2)
    if not low <= rate / RATE_HZ <= high:
        raise LogError(
            f"{source}: column time_s: {rate:.2f} Hz, but must be {RATE_HZ} Hz; resample the log, "
            "with time_s in seconds"
        )
    if uneven.size:
        row = uneven[0] + 1
        raise LogError(
            f"{source}: row {row}, column time_s: {steps[row - 1] * 1e3:.1f} ms after row "
            f"{row - 1}, but must be 10 ms ({_count(uneven.size)} in this log); split the log "
            "there, or record it again"
        )


def _count(number: int) -> str:
    return "the only one" if number == 1 else f"the first of {number}"


def read_parquet(path: Path) -> pa.Table:
    """Read a Parquet file from any source; raises LogError if it is damaged."""
    try:
        with path.open("rb") as file:
            table = pq.ParquetFile(file, page_checksum_verification=True).read()
        # Arrow decodes column names only on access.
        _ = table.schema.names
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        # Arrow's own errors may be OSErrors as well, but without the system's reason.
        if isinstance(error, OSError) and error.strerror:
            raise LogError(
                f"{path}: cannot be read ({error.strerror}); use the path of a Parquet file"
            ) from None
        reason = one_line(error)
        raise LogError(
            f"{path}: truncated, or not a Parquet file ({reason}); copy it again"
        ) from None
    check_file_format("log", table.schema.metadata, str(path))
    return table
