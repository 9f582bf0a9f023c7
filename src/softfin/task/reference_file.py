"""Reference forces from a file: a CSV or Parquet table with ``time_s``, ``force_x_n`` and ``force_y_n``; others unread.

Each row is asked from its time on until the next one. Logs of softfin have these columns too; their times begin one
tick after the start, at 0.01 s: a first row up to one tick late is asked from 0 on.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import TICK_S
from softfin.data.importing.names import SPELLED, UNITS
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import check_reference_file
from softfin.task.signals import CLOCK_S, Recorded

COLUMNS = {
    "time_s": ("s", "seconds", "time"),
    "force_x_n": ("n", "newton", "force"),
    "force_y_n": ("n", "newton", "force"),
}
"""Columns that are read: the unit that the name ends in, its word, and the quantity."""

LONGEST_S = 3600.0
"""Longest reference that is followed [s]; a longer one is in another unit."""


MOST_ROWS = 360_000
"""An hour at 100 Hz, the rate of readings."""


def read_reference_file(path: Path) -> Recorded:
    """The reference over time; raises ConfigurationError naming the row, what is wrong with it and the way out."""
    check_reference_file(path)
    try:
        values = _read(path)
    except (OSError, LogError, UnicodeDecodeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:300]
        raise _error(path, f"not a table of numbers ({reason}); mend it, or write it again") from None
    if len(values) > MOST_ROWS:
        raise _error(path, f"has {len(values):,} rows; at most {MOST_ROWS:,} are followed; leave rows out")
    if not len(values):
        raise _error(path, "empty: no rows; give at least one, at time_s = 0")
    for row, column in np.argwhere(~np.isfinite(values)).tolist():
        name, value = list(COLUMNS)[column], values[row, column]
        raise _error(path, f"row {row + 1}, column {name}: {value:g} is not a finite number; write one, or leave that "
                           "row out, and the force before it is held")  # fmt: skip
    times = values[:, 0]
    if not -CLOCK_S <= times[0] <= TICK_S + CLOCK_S:
        raise _error(path, f"time_s begins at {times[0]:g}; begin at 0: subtract {times[0]:g} from all times, or add a "
                           "row at 0")  # fmt: skip
    for row in np.flatnonzero(np.diff(times) <= 0).tolist():
        raise _error(path, f"row {row + 2}: time_s = {times[row + 1]:g} after {times[row]:g}; times must grow: sort "
                           "the rows, one for each time")  # fmt: skip
    recorded = Recorded(time_s=(0.0, *times[1:].tolist()), force_n=tuple(map(tuple, values[:, 1:].tolist())))
    if recorded.seconds > LONGEST_S:
        raise _error(path, f"time_s up to {times[-1]:g} makes {recorded.seconds} s; at most {LONGEST_S:g} s are "
                           "followed: are these milliseconds? Then divide them by 1000; else cut the file")  # fmt: skip
    return recorded


def _error(path: Path, message: str) -> ConfigurationError:
    return ConfigurationError(f"--reference-file {path}: {message}")


def _read(path: Path) -> Float[np.ndarray, "rows 3"]:
    if path.suffix == ".csv":
        table = pa.csv.read_csv(path, pa.csv.ReadOptions(use_threads=False))
        table = table.rename_columns([name.strip() for name in table.column_names])
    else:
        table = read_parquet(path)
    _check_columns(path, table.column_names)
    columns = (table.column(name).cast(pa.float64()).to_numpy() for name in COLUMNS)
    return np.stack(tuple(columns), axis=1)


def _check_columns(path: Path, header: list[str]) -> None:
    """Raise ConfigurationError where a column is missing, there twice, or given in another unit."""
    for name, (unit, word, kind) in COLUMNS.items():
        if header.count(name) == 1:
            continue
        if name in header:
            raise _error(path, f"column {name} is there twice; take one of them out")
        quantity = name.removesuffix(f"_{unit}")
        other = next((met for met in header if met.lower() == quantity or met.lower().startswith(f"{quantity}_")), None)
        if other is None:
            raise _error(path, f"no column {name} among {', '.join(header)}; it needs {','.join(COLUMNS)}")
        met = SPELLED[kind].get(other.lower().removeprefix(f"{quantity}_"))
        change = f"{f'multiply it by {UNITS[kind][met]:.7g}' if met else f'give it in {word}'} and name it {name}"
        raise _error(path, f"column {other} is not in {word}, which is needed; {change}")
