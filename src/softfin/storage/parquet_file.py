"""Parquet files of any origin: opened, or refused in one line before their rows are read."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from softfin.core.errors import LogError
from softfin.core.files import regular_file

MOST_ROWS = 20_000_000
"""Rows of one file: five hours at 1 kHz, two days at 100 Hz."""


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a file, its rows not yet read; raises LogError where it is damaged or holds more than `MOST_ROWS`."""
    try:
        file = pq.ParquetFile(regular_file(path), page_checksum_verification=True)
        # Arrow decodes the names of columns only when they are asked for.
        _ = file.schema_arrow.names
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise damaged(path, error) from None
    rows = file.metadata.num_rows
    if rows > MOST_ROWS:
        raise LogError(f"{path}: has {rows:,} rows; at most {MOST_ROWS:,} are read; cut it into several files")
    return file


def damaged(path: Path, error: Exception) -> LogError:
    """Make the error of a file that Arrow cannot read."""
    if isinstance(error, OSError) and error.strerror:
        return LogError(f"{path}: cannot be read ({error.strerror}); give the path of a Parquet file")
    reason = " ".join(str(error).split())[:500] or type(error).__name__
    return LogError(f"{path}: truncated, or not a Parquet file ({reason}); copy it again")
