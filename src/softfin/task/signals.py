"""Moving references, from a formula or a file: one reference force for every tick of 10 ms.

Tick k starts at k * 10 ms and lasts 10 ms. A controller reads the reference when it acts, three
times per second, so it sees a change between two actions at the second one.

A file is a CSV or Parquet table with ``time_s``, ``force_x_n`` and ``force_y_n``; other columns are
ignored. Each row applies from its time until the next row. softfin's logs also have these columns,
but start one tick late, at 0.01 s; a first row up to one tick late therefore applies from time 0.
"""

from abc import abstractmethod
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Float
from pydantic import Field, FiniteFloat, NonNegativeFloat, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, LogError, one_line
from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.gaits.reachable import format_force
from softfin.storage.log_file import read_parquet
from softfin.storage.paths import check_reference_file

ReferenceForce = tuple[FiniteFloat, FiniteFloat]

TickTimes = Float[np.ndarray, " ticks"]
ReferenceSamples = Float[np.ndarray, "ticks 2"]
"""Reference forces (x, y) [N]; float32 outside this module."""

CLOCK_S = 1e-6
"""Distance from a tick within which a time is assigned to that tick [s]. It is needed because sums
of decimal fractions are rarely exact."""

REFERENCE_COLUMNS = {"time_s": "seconds", "force_x_n": "newtons", "force_y_n": "newtons"}
"""Columns of a reference file, with their units."""

MAX_SIGNAL_S = 3600.0
"""Maximum duration of a reference [s]; a longer one is probably in another unit."""

MAX_REFERENCE_ROWS = 360_000
"""Maximum number of rows: an hour at 100 Hz, the rate of readings."""


class Signal(Configuration):
    """Base class of all signals; `kind` identifies the class in files."""

    kind: str

    @abstractmethod
    def _at(self, time_s: TickTimes) -> ReferenceSamples:
        """Return the reference (x, y) [N] at each time."""

    def sample(self, ticks: int) -> ReferenceSamples:
        """Return the reference at 100 Hz, starting at time 0."""
        return np.asarray(self._at(np.arange(ticks) / RATE_HZ), np.float32)


class Step(Signal):
    """A step from one force to another."""

    kind: Literal["step"] = "step"
    start_n: ReferenceForce
    """Force before the step (x, y) [N]."""
    to_n: ReferenceForce
    """Force after the step (x, y) [N]."""
    at_s: NonNegativeFloat = 10.0
    """Time of the step [s]; controllers act at every whole second."""

    def _at(self, time_s: TickTimes) -> ReferenceSamples:
        return np.where(time_s[:, None] >= self.at_s - CLOCK_S, self.to_n, self.start_n)

    def __str__(self) -> str:
        start, to = map(format_force, (self.start_n, self.to_n))
        return f"step {start} to {to} N at {self.at_s:g} s"


class Ramp(Signal):
    """A ramp from one force to another."""

    kind: Literal["ramp"] = "ramp"
    start_n: ReferenceForce
    """Force before the ramp (x, y) [N]."""
    to_n: ReferenceForce
    """Force after the ramp (x, y) [N]."""
    begin_s: NonNegativeFloat = 5.0
    """Start of the ramp [s]."""
    end_s: PositiveFloat = 15.0
    """End of the ramp [s]."""

    @model_validator(mode="after")
    def _ordered(self) -> "Ramp":
        if self.end_s <= self.begin_s:
            raise ValueError(
                f"ramp from {self.begin_s:g} s to {self.end_s:g} s; end_s must be after begin_s"
            )
        return self

    def _at(self, time_s: TickTimes) -> ReferenceSamples:
        # (1 - s) start + s to, with s from 0 to 1 over the ramp
        part = np.clip((time_s[:, None] - self.begin_s) / (self.end_s - self.begin_s), 0, 1)
        return np.asarray((1 - part) * self.start_n + part * np.asarray(self.to_n))

    def __str__(self) -> str:
        start, to = map(format_force, (self.start_n, self.to_n))
        return f"ramp {start} to {to} N from {self.begin_s:g} s to {self.end_s:g} s"


class Sinusoid(Signal):
    """Oscillation about a force, with both axes in phase."""

    kind: Literal["sine"] = "sine"
    centre_n: ReferenceForce
    """Force at time 0 and after half a period (x, y) [N]."""
    amplitude_n: ReferenceForce
    """Amplitude of each axis (x, y) [N]; if negative, the force decreases first."""
    period_s: PositiveFloat = 10.0
    """Period [s]; 10 s are five windows of the moving average."""

    def _at(self, time_s: TickTimes) -> ReferenceSamples:
        turn = np.sin(2 * np.pi * time_s[:, None] / self.period_s)
        return np.asarray(np.asarray(self.centre_n) + turn * np.asarray(self.amplitude_n))

    def __str__(self) -> str:
        centre, amplitude = map(format_force, (self.centre_n, self.amplitude_n))
        return f"sine about {centre} N, amplitude {amplitude} N, of {self.period_s:g} s"


class Recorded(Signal):
    """Forces that start at given times, each held until the next one; the last one is held forever.
    Nothing is interpolated."""

    kind: Literal["recorded"] = "recorded"
    time_s: tuple[FiniteFloat, ...] = Field(min_length=1)
    """Times at which each force starts [s], increasing from 0."""
    force_n: tuple[ReferenceForce, ...] = Field(min_length=1)
    """Forces (x, y) at those times [N]."""

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
        """Duration in whole seconds, if the last force lasts as long as the one before it."""
        last = self.time_s[-1]
        before = self.time_s[-2] if len(self.time_s) > 1 else 0.0
        # last + (last - before), rounded up
        return int(np.ceil(2 * last - before - CLOCK_S))

    def _at(self, time_s: TickTimes) -> ReferenceSamples:
        return np.asarray(self.force_n)[
            np.searchsorted(self.time_s, time_s + CLOCK_S, side="right") - 1
        ]

    def __str__(self) -> str:
        if len(self.force_n) == 2:
            return str(Step(start_n=self.force_n[0], to_n=self.force_n[1], at_s=self.time_s[1]))
        return f"recorded, {len(self.time_s)} rows over {self.time_s[-1]:g} s"


def read_reference_file(path: Path) -> Recorded:
    """Read a reference over time; raises ConfigurationError with the row, the problem and the
    fix."""
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
            f"{source}: {met}; correct it, or remove the row, and the previous force is held"
        )
    # softfin's own logs start one tick late; see the top of this module.
    if -CLOCK_S <= values[0, 0] <= TICK_S + CLOCK_S:
        values[0, 0] = 0.0
    recorded = Recorded.build(
        {"time_s": values[:, 0].tolist(), "force_n": values[:, 1:].tolist()}, source
    )
    if recorded.seconds > MAX_SIGNAL_S:
        raise ConfigurationError(
            f"{source}: time_s up to {values[-1, 0]:g} makes {recorded.seconds} s, but at most "
            f"{MAX_SIGNAL_S:g} s are allowed; divide by 1000 if time_s is in milliseconds, or "
            "shorten the file"
        )
    return recorded
