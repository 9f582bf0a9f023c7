"""Reference forces from a file: a CSV or Parquet table with ``time_s``, ``force_x_n`` and ``force_y_n``; others unread.

Each row is asked from its time on until the next one. Logs of softfin have these columns too; their times begin one
tick after the start, at 0.01 s: a first row up to one tick late is asked from 0 on.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import TICK_S
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import check_reference_file
from softfin.task.signals import CLOCK_S, Recorded

COLUMNS = {"time_s": "seconds", "force_x_n": "newton", "force_y_n": "newton"}
"""Columns that are read, and their units."""

LONGEST_S = 3600.0
"""Longest reference that is followed [s]; a longer one is in another unit."""

MOST_ROWS = 360_000
"""An hour at 100 Hz, the rate of readings."""


def read_reference_file(path: Path) -> Recorded:
    """The reference over time; raises ConfigurationError naming the row, what is wrong with it and the way out."""
    check_reference_file(path)
    source = f"--reference-file {path}"
    try:
        if path.suffix == ".csv":
            table = pa.csv.read_csv(path, pa.csv.ReadOptions(use_threads=False))
            table = table.rename_columns([name.strip() for name in table.column_names])
        else:
            table = read_parquet(path)
        for name, unit in COLUMNS.items():
            if table.column_names.count(name) != 1:
                raise ConfigurationError(
                    f"{source}: no column {name}, or several, among {', '.join(table.column_names)}; it needs one in "
                    f"{unit}: convert it, and name it {name}"
                )
        values = np.stack([table.column(name).cast(pa.float64()).to_numpy() for name in COLUMNS], axis=1)
    except (OSError, LogError, UnicodeDecodeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:300]
        raise ConfigurationError(f"{source}: not a table of numbers ({reason}); mend it, or write it again") from None
    if not 0 < len(values) <= MOST_ROWS:
        raise ConfigurationError(f"{source}: has {len(values):,} rows; 1 to {MOST_ROWS:,} are followed, from 0 s on")
    for row, column in np.argwhere(~np.isfinite(values)).tolist():
        met = f"row {row + 1}, column {list(COLUMNS)[column]}: {values[row, column]:g} is not a finite number"
        raise ConfigurationError(f"{source}: {met}; write one, or leave that row out, and the force before it is held")
    if -CLOCK_S <= values[0, 0] <= TICK_S + CLOCK_S:
        values[0, 0] = 0.0
    recorded = Recorded.build({"time_s": values[:, 0].tolist(), "force_n": values[:, 1:].tolist()}, source)
    if recorded.seconds > LONGEST_S:
        raise ConfigurationError(
            f"{source}: time_s up to {values[-1, 0]:g} makes {recorded.seconds} s; at most {LONGEST_S:g} s are "
            "followed: are these milliseconds? Then divide them by 1000; else cut the file"
        )
    return recorded
