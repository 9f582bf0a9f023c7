"""Logs of the virtual tank and of the published fin, and what can go wrong with them."""

import functools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

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


@functools.cache
def _five(fin: str) -> tuple[Log, ...]:
    values = {}
    if fin != "tank":
        values = yaml.safe_load((FINS / f"{fin}.yaml").read_text())
    return recorded(Tank(TankConfig(**values)), 5, ROWS)


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
