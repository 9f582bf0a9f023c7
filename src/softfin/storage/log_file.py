"""One log as one Parquet file: seven named columns, checked whole when written and when read.

A Log goes in and the same Log comes out; a log that cannot be used for training raises a LogError with place and cause.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Log, Reading
from softfin.storage import artifact as artifacts

SCHEMA = pa.schema(
    [
        # float64: a float32 resolves 10 ms no more after 36 hours, and the clock of a computer (1.7e9 s) not at all.
        pa.field("time_s", pa.float64()),
        pa.field("command_angle_rad", pa.float32()),
        pa.field("command_velocity_rad_s", pa.float32()),
        pa.field("angle_rad", pa.float32()),
        pa.field("velocity_rad_s", pa.float32()),
        pa.field("force_x_n", pa.float32()),
        pa.field("force_y_n", pa.float32()),
    ]
)

RATE_TOLERANCE = 0.01
"""Largest relative error of the mean rate."""

Columns = dict[str, NDArray[np.floating]]


def write_log(path: Path, log: Log) -> None:
    """Write a log; raises LogError, and writes nothing, where `read_log` would refuse it."""
    artifacts.write_file(path, encode_log(log, str(path)))


def encode_log(log: Log, source: str) -> bytes:
    """The bytes of a log's file; raises LogError, under the name `source`, where `read_log` would refuse it."""
    command, reading = log
    force = np.asarray(reading.force)
    series = (reading.time, *command, reading.angle, reading.velocity, force[..., 0], force[..., 1])
    columns = {
        field.name: np.asarray(values, field.type.to_pandas_dtype())
        for field, values in zip(SCHEMA, series, strict=True)
    }
    check_columns(columns, source)
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns, schema=SCHEMA), sink, compression="zstd", write_page_checksum=True)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def read_log(path: Path) -> Log:
    """Read a log as NumPy arrays; raises LogError naming file, row, column, value and what to do."""
    columns = _read_columns(path)
    check_columns(columns, str(path))
    command = Command(columns["command_angle_rad"], columns["command_velocity_rad_s"])
    force = np.stack([columns["force_x_n"], columns["force_y_n"]], axis=1)
    return Log(command, Reading(columns["time_s"], columns["angle_rad"], columns["velocity_rad_s"], force))


def check_columns(columns: Columns, source: str) -> None:
    """Raise LogError unless the columns hold rows, finite values and a steady 100 Hz clock."""
    if not columns["time_s"].size:
        raise LogError(f"{source}: empty: it has no rows; record it again")
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise LogError(
                f"{source}: row {bad[0]}, column {name}: {values[bad[0]]} ({_count(bad.size)} in this column); "
                "cut these rows off, or split the log around them"
            )
    _check_clock(columns["time_s"], source)


def _check_clock(time: NDArray[np.floating], source: str) -> None:
    steps = np.diff(time)
    backward = np.flatnonzero(steps <= 0)
    if backward.size:
        row = backward[0] + 1
        raise LogError(
            f"{source}: row {row}, column time_s: {time[row]:.4f} s repeats or precedes row {row - 1} "
            f"({time[row - 1]:.4f} s); remove repeated rows, sort by time_s"
        )
    # The median first: at a wrong rate every step would be called a gap.
    if steps.size and not 0.5 < np.median(steps) / TICK_S < 1.5:
        raise _wrong_rate(1 / float(np.median(steps)), source)
    uneven = np.flatnonzero(np.abs(steps - TICK_S) > 0.5 * TICK_S)
    if uneven.size:
        row = uneven[0] + 1
        raise LogError(
            f"{source}: row {row}, column time_s: {steps[row - 1] * 1e3:.1f} ms after row {row - 1}, must be 10 ms "
            f"({_count(uneven.size)} in this log); split the log there, or record it again"
        )
    # A handful of rows on a clock with jitter does not show a rate.
    if steps.size >= RATE_HZ:
        mean_rate = steps.size / float(time[-1] - time[0])
        if abs(mean_rate / RATE_HZ - 1) > RATE_TOLERANCE:
            raise _wrong_rate(mean_rate, source)


def _wrong_rate(rate: float, source: str) -> LogError:
    return LogError(f"{source}: column time_s: {rate:.2f} Hz, must be {RATE_HZ} Hz; resample it, time_s is in seconds")


def _count(number: int) -> str:
    return "the only one" if number == 1 else f"the first of {number}"


def read_parquet(path: Path) -> pa.Table:
    """Read a Parquet file of any origin; raises LogError where it is damaged."""
    try:
        with path.open("rb") as file:
            table = pq.ParquetFile(file, page_checksum_verification=True).read()
        # Arrow decodes the names of columns only when they are asked for.
        _ = table.schema.names
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if isinstance(error, OSError) and error.strerror:
            raise LogError(f"{path}: cannot be read ({error.strerror}); give the path of a Parquet file") from None
        reason = " ".join(str(error).split())[:500] or type(error).__name__
        raise LogError(f"{path}: truncated, or not a Parquet file ({reason}); copy it again") from None
    return table


def _read_columns(path: Path) -> Columns:
    table = read_parquet(path)
    names = table.schema.names
    missing = [name for name in SCHEMA.names if name not in names]
    excess = [name for name in names if name not in SCHEMA.names or names.count(name) > 1]
    for column, fix in [(missing, "is missing"), (excess, "must not be there, or only once")]:
        if column:
            raise LogError(f"{path}: column {column[0]!r} {fix}; it has {names}; a log has {', '.join(SCHEMA.names)}")
    for field in SCHEMA:
        if (kind := table.schema.field(field.name).type) != field.type:
            raise LogError(f"{path}: column {field.name} is {kind}, must be {field.type}; cast it")
    return {name: table.column(name).to_numpy() for name in SCHEMA.names}
