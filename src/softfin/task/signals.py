"""Moving references, such as steps or the rows of a file: one reference force for every tick of
10 ms.

Tick k starts at k * 10 ms and lasts 10 ms. A controller reads the reference when it acts, three
times per second, so it reacts to a change between two actions at the second action.

A file is a CSV or Parquet table with the columns ``time_s``, ``force_x_n`` and ``force_y_n``; other
columns are ignored. Each row applies from its time until the next row. softfin's logs also have
these columns, but start at 0.01 s, so a first row up to one tick late applies from time 0.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float
from pydantic import Field, FiniteFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, LogError, one_line
from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.gaits.reachable import ForceVector, format_force
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import check_reference_file

ReferenceForce = tuple[FiniteFloat, FiniteFloat]

ReferenceSamples = Float[np.ndarray, "ticks 2"]
"""Reference forces (x, y) [N]."""

CLOCK_S = 1e-6
"""Maximum distance from a tick at which a time is assigned to the tick [s]; needed because sums of
decimal fractions are rarely exact."""

REFERENCE_COLUMNS = {"time_s": "seconds", "force_x_n": "newtons", "force_y_n": "newtons"}
"""Columns of a reference file, with their units."""

MAX_SIGNAL_S = 3600.0
"""Maximum duration of a reference [s]; a longer reference probably has a different time unit."""

MAX_REFERENCE_ROWS = 360_000
"""Maximum number of rows: one hour at 100 Hz."""


class Recorded(Configuration):
    """Forces that start at given times. Each is held until the next one without interpolation, and
    the last is held forever."""

    time_s: tuple[FiniteFloat, ...] = Field(min_length=1)
    """Start time of each force [s], increasing from 0."""
    force_n: tuple[ReferenceForce, ...] = Field(min_length=1)
    """Force (x, y) from each of these times [N]."""

    @model_validator(mode="after")
    def _ordered(self) -> "Recorded":
        times = np.asarray(self.time_s)
        if len(times) != len(self.force_n):
            raise ValueError(
                f"{len(times)} times and {len(self.force_n)} forces; use one force per time"
            )
        if abs(times[0]) > CLOCK_S:
            raise ValueError(
                f"the first time is {times[0]:g} s; start at 0, because the reference before it is "
                "unknown"
            )
        if late := np.flatnonzero(np.diff(times) <= 0).tolist():
            raise ValueError(
                f"time {times[late[0] + 1]:g} s after {times[late[0]]:g} s; times must increase"
            )
        return self

    @property
    def seconds(self) -> int:
        """Duration in full seconds, assuming that the last force lasts as long as the previous
        one."""
        last = self.time_s[-1]
        before = self.time_s[-2] if len(self.time_s) > 1 else 0.0
        # last + (last - before), rounded up
        return int(np.ceil(2 * last - before - CLOCK_S))

    def sample(self, ticks: int) -> ReferenceSamples:
        """Return the reference (x, y) at 100 Hz, starting at time 0."""
        time_s = np.arange(ticks) / RATE_HZ + CLOCK_S
        rows = np.searchsorted(self.time_s, time_s, side="right") - 1
        return np.asarray(self.force_n, np.float32)[rows]

    def __str__(self) -> str:
        if len(self.force_n) == 2:
            start, to = map(format_force, self.force_n)
            return f"step {start} to {to} N at {self.time_s[1]:g} s"
        return f"recorded, {len(self.time_s)} rows over {self.time_s[-1]:g} s"


def step(start_n: ForceVector, to_n: ForceVector, at_s: float | int = 10.0) -> Recorded:
    """Return a reference that steps from one force to a second one [N]."""
    return Recorded(time_s=(0.0, at_s), force_n=(start_n, to_n))


def read_reference_file(path: Path) -> Recorded:
    """Read a reference over time; raises ConfigurationError with the row, the problem and the fix
    if the file is invalid."""
    check_reference_file(path)
    source = f"--reference-file {path}"
    try:
        if path.suffix == ".csv":
            table = pa.csv.read_csv(path, pa.csv.ReadOptions(use_threads=False))
            table = table.rename_columns([name.strip() for name in table.column_names])
        else:
            table = read_parquet(path)
        for name, unit in REFERENCE_COLUMNS.items():
            if table.column_names.count(name) != 1:
                raise ConfigurationError(
                    f"{source}: must have exactly one column {name}, got "
                    f"{', '.join(table.column_names)}; convert a column to {unit}, and rename it "
                    f"to {name}"
                )
        values = np.stack(
            [table.column(name).cast(pa.float64()).to_numpy() for name in REFERENCE_COLUMNS], axis=1
        )
    except (OSError, LogError, UnicodeDecodeError, pa.ArrowException) as error:
        reason = one_line(error)
        raise ConfigurationError(
            f"{source}: not a table of numbers ({reason}); repair the file, or write it again"
        ) from None
    if not 0 < len(values) <= MAX_REFERENCE_ROWS:
        raise ConfigurationError(
            f"{source}: has {len(values):,} rows; it must have 1 to {MAX_REFERENCE_ROWS:,}, "
            "starting at 0 s"
        )
    for row, column in np.argwhere(~np.isfinite(values)).tolist():
        met = (
            f"row {row + 1}, column {list(REFERENCE_COLUMNS)[column]}: {values[row, column]:g} "
            "is not a finite number"
        )
        raise ConfigurationError(
            f"{source}: {met}; correct it, or remove the row to hold the previous force"
        )
    # softfin's own logs start one tick late; see the top of this module.
    if -CLOCK_S <= values[0, 0] <= TICK_S + CLOCK_S:
        values[0, 0] = 0.0
    recorded = Recorded.build(
        {"time_s": values[:, 0].tolist(), "force_n": values[:, 1:].tolist()}, source
    )
    if recorded.seconds > MAX_SIGNAL_S:
        raise ConfigurationError(
            f"{source}: time_s up to {values[-1, 0]:g} corresponds to {recorded.seconds} s, but at "
            f"most {MAX_SIGNAL_S:g} s are allowed; divide by 1000 if time_s is in milliseconds, or "
            "shorten the file"
        )
    return recorded
