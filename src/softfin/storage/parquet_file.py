"""Parquet files of anybody, opened within bounds: what a file says of itself is looked at before its rows are read."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from softfin.core.errors import LogError
from softfin.core.files import regular_file

MOST_ROWS = 20_000_000
"""Of one file: five hours at 1 kHz, two days at 100 Hz."""

MOST_BYTES = 4 * 2**30
"""Of one file, on the disk and again as columns in memory: two hundred bytes for each row."""

MOST_COLUMNS = 1000
LONGEST_NAME = 1000

MOST_LISTED = 100_000
"""Entries of the file's description: row groups times columns. Each costs memory before a row is read."""


def open_parquet(path: Path) -> pq.ParquetFile:
    """The file, its rows not yet read; raises LogError, in one line, where it is none or holds more than the bounds."""
    try:
        regular_file(path, MOST_BYTES)
        file = pq.ParquetFile(
            path, page_checksum_verification=True, thrift_container_size_limit=MOST_LISTED,
            thrift_string_size_limit=2**24,
        )  # fmt: skip
        names = file.schema_arrow.names
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise damaged(path, error) from None
    metadata = file.metadata
    check_rows(path, metadata.num_rows)
    check_names(path, names)
    size = sum(max(metadata.row_group(group).total_byte_size, 0) for group in range(metadata.num_row_groups))
    if size > MOST_BYTES:
        raise LogError(f"{path}: unpacks to {size:,} bytes; at most {MOST_BYTES:,} are read; cut it into several files")
    return file


def check_rows(path: Path, rows: int) -> None:
    """Raise LogError where there are more rows than are read."""
    if rows > MOST_ROWS:
        raise LogError(f"{path}: has {rows:,} rows or more; at most {MOST_ROWS:,} are read; cut it into several files")


def check_names(path: Path, names: list[str]) -> None:
    """Raise LogError where there are more columns, or longer names, than any log has."""
    if len(names) > MOST_COLUMNS:
        raise LogError(f"{path}: has {len(names):,} columns; at most {MOST_COLUMNS:,} are read; leave others out")
    long = next((name for name in names if len(name) > LONGEST_NAME), None)
    if long is not None:
        raise LogError(f"{path}: a column's name has {len(long):,} letters; at most {LONGEST_NAME:,} are read")


def damaged(path: Path, error: Exception) -> LogError:
    """What a file is that Arrow cannot read."""
    if isinstance(error, OSError) and error.strerror:
        return LogError(f"{path}: cannot be read ({error.strerror}); give the path of a Parquet file")
    reason = " ".join(str(error).split())[:500] or type(error).__name__
    return LogError(f"{path}: truncated, or not a Parquet file ({reason}); copy it again")
