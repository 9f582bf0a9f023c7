"""Logs of the virtual tank and of the published fin, and what can go wrong with them."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from scipy import signal

from softfin.core.plant import Plant
from softfin.core.quantities import Command, Log, Reading
from softfin.core.randomness import named_key
from softfin.data.excitation import ExcitationConfig
from softfin.data.importing.clocks import NamedLog
from softfin.data.simulate import simulate
from softfin.storage.log_file import SCHEMA
from softfin.tank import Tank, TankConfig

FINS = Path(__file__).parents[2] / "examples" / "fins"

ROWS = 6000

Columns = dict[str, np.ndarray]

Fault = Callable[[Columns], None]
"""Changes the columns of a log."""

FORCES = ("force_x_n", "force_y_n")
ANGLES = ("angle_rad", "command_angle_rad")


def tank(fin: str = "tank") -> Tank:
    """The default tank, or one with a fin of the examples."""
    values = {}
    if fin != "tank":
        values = yaml.safe_load((FINS / f"{fin}.yaml").read_text())
    return Tank(TankConfig(**values))


@functools.cache
def _five(fin: str) -> tuple[Log, ...]:
    return recorded(tank(fin), 5, ROWS)


def tank_logs(count: int = 2, fin: str = "tank") -> tuple[Log, ...]:
    """Of the default tank or of a fin in the examples, under random commands; at most five. Do not
    change their arrays."""
    return _five(fin)[:count]


def cut(log: Log, start: int, end: int) -> Log:
    return log_of({name: values[start:end] for name, values in to_columns(log).items()})


def recorded(plant: Plant, count: int, rows: int) -> tuple[Log, ...]:
    keys = [named_key(0, f"tests/{index}") for index in range(count)]
    logs = simulate([plant] * count, keys, rows, ExcitationConfig(), count, lambda _: None)
    clock = np.arange(1, rows + 1) / 100
    return tuple(Log(log.command, log.reading._replace(time=clock)) for log in logs)


def named(*logs: Log, test: int = 1) -> list[NamedLog]:
    """The last `test` of them to score on."""
    parts = ["train"] * (len(logs) - test) + ["test"] * test
    return [
        NamedLog(f"{part}/{i}", part, log)
        for i, (part, log) in enumerate(zip(parts, logs, strict=True))
    ]


def to_columns(log: Log) -> Columns:
    force = np.asarray(log.reading.force, np.float64)
    series = (
        log.reading.time,
        *log.command,
        log.reading.angle,
        log.reading.velocity,
        force[:, 0],
        force[:, 1],
    )
    return {
        name: np.array(values, np.float64)
        for name, values in zip(SCHEMA.names, series, strict=True)
    }


def log_of(columns: Columns) -> Log:
    single = {name: values.astype(np.float32) for name, values in columns.items()}
    force = np.stack([single["force_x_n"], single["force_y_n"]], axis=1)
    reading = Reading(columns["time_s"], single["angle_rad"], single["velocity_rad_s"], force)
    return Log(Command(single["command_angle_rad"], single["command_velocity_rad_s"]), reading)


def write_parquet(path: Path, columns: Columns) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def delayed(values: np.ndarray, ticks: int) -> np.ndarray:
    return np.roll(values, ticks)


def turned(degrees: float | None) -> Fault:
    """Without an angle, the sensor turns with the shaft."""

    def fault(columns: Columns) -> None:
        angle = columns["angle_rad"] if degrees is None else np.radians(degrees)
        x, y = (columns[name] for name in FORCES)
        columns["force_x_n"] = x * np.cos(angle) - y * np.sin(angle)
        columns["force_y_n"] = x * np.sin(angle) + y * np.cos(angle)

    return fault


def of_forces(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def fault(columns: Columns) -> None:
        for name in FORCES:
            columns[name] = change(columns[name])

    return fault


def times(name: str, factor: float) -> Fault:
    def fault(columns: Columns) -> None:
        columns[name] = columns[name] * factor

    return fault


def drifting(values: np.ndarray) -> np.ndarray:
    return values + np.linspace(-0.7, 0.7, len(values)) * values.std()


def low_passed(cutoff_hz: float) -> Callable[[np.ndarray], np.ndarray]:
    factor = np.exp(-2 * np.pi * cutoff_hz / 100)
    return lambda values: signal.lfilter([1 - factor], [1, -factor], values)


def smoothed_afterwards(values: np.ndarray) -> np.ndarray:
    both_ways = signal.butter(2, 2 / 50)
    return signal.filtfilt(*both_ways, values)


def held(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[::10], 10)[: len(values)]


def clipped_and_averaged(values: np.ndarray) -> np.ndarray:
    limit = np.percentile(np.abs(values), 92)
    return np.convolve(np.clip(values, -limit, limit), np.full(5, 0.2), "same")


def frozen(values: np.ndarray) -> np.ndarray:
    """But for a count in either direction, in two stretches."""
    count = 1e-3 * np.ptp(values)
    values = np.round(values / count) * count
    noise = np.random.default_rng(0).integers(-1, 2, len(values)) * count
    for start in (1000, 4000):
        values[start : start + 1000] = values[start] + noise[:1000]
    return values


def with_zeros_and_doubles(values: np.ndarray) -> np.ndarray:
    rows = np.random.default_rng(0).choice(len(values), 120, replace=False)
    values[rows[:60]] = 0
    values[rows[60:]] *= 2
    return values


def late(ticks: int) -> Fault:
    return of_forces(lambda values: np.roll(values, ticks))


def late_at_times(columns: Columns) -> None:
    for name in FORCES:
        delayed = np.roll(columns[name], 30)
        for start in (1200, 4200):
            columns[name][start : start + 600] = delayed[start : start + 600]


def slower_loop(columns: Columns) -> None:
    """At 80 Hz, stamped as 100 Hz. The velocity is the drive's."""
    time = columns["time_s"]
    stamps = time[: len(time) * 4 // 5]
    for name in columns:
        if name != "time_s":
            columns[name] = np.interp(stamps * 1.25, time, columns[name])
    columns["time_s"] = stamps


def repeated(columns: Columns) -> None:
    again = np.arange(len(columns["time_s"])) // 4 * 4
    for name in columns:
        if name != "time_s":
            rows = np.arange(len(again))
            rows[again + 1 == rows] -= 1
            columns[name] = columns[name][rows]


def shifted(degrees: float) -> Fault:
    def fault(columns: Columns) -> None:
        for name in ANGLES:
            columns[name] = columns[name] + np.radians(degrees)

    return fault


FAULTS = {
    "turned by 20 degrees": turned(20),
    "turned by -30 degrees": turned(-30),
    "turned by 45 degrees": turned(45),
    "turned with the shaft": turned(None),
    "drift": of_forces(drifting),
    "low-pass of 2 Hz": of_forces(low_passed(2)),
    "low-pass in both directions": of_forces(smoothed_afterwards),
    "sensor at 10 Hz": of_forces(held),
    "clipped": of_forces(clipped_and_averaged),
    "frozen": of_forces(frozen),
    "single samples": of_forces(with_zeros_and_doubles),
    "force 300 ms late": late(30),
    "force 3 s early": late(-300),
    "force late at times": late_at_times,
    "force in counts": of_forces(lambda values: values * 1000000.0),
    "velocity in rpm": times("velocity_rad_s", 9.549),
    "velocity in degrees": times("velocity_rad_s", 57.3),
    "clock": slower_loop,
    "command in rpm": times("command_velocity_rad_s", 9.549),
    "command in degrees": times("command_velocity_rad_s", 57.3),
    "command read as degrees": times("command_velocity_rad_s", 1 / 57.3),
    "command in registers": times("command_velocity_rad_s", 41.7),
    "10-bit counts": times("angle_rad", 0.293),
    "repeated rows": repeated,
}
