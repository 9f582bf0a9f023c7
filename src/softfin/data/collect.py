"""Collects a dataset from a plant under random commands (paper Sec. III-A).

One program simulates many logs. The dataset folder is written completely or not at all. Log i of a
part (train or test) draws all random numbers from the key ``collect/PART/i``, so it does not depend
on logs that are simulated in parallel.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pydantic

from softfin.core.configuration import Configuration
from softfin.core.errors import PlantError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.core.randomness import named_key
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import MeasuringPlant, simulate
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.paths import DATASET_PARTS


class CollectConfig(Configuration):
    """Configuration of a data collection: number, length and commands of the logs."""

    logs: int = pydantic.Field(default=100, ge=1)
    """Number of training logs; the paper uses 100."""
    test_logs: int = pydantic.Field(default=3, ge=0)
    """Number of test logs; the paper uses 3, from perturbed tanks."""
    rows: int = pydantic.Field(default=20_000, ge=2)
    """Number of readings per log at 100 Hz; the paper uses 20,000, i.e. 200 s."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the commands and of all randomness in the plant."""
    batch: int = pydantic.Field(default=100, ge=1)
    """Maximum number of logs simulated in parallel. A larger number is faster, but each log needs
    about 30 bytes of memory per row."""
    excitation: ExcitationConfig = ExcitationConfig()
    """Random commands."""
    channels: bool = False
    """Whether the logs of a simulated plant also contain its additional channels, such as torque
    and current in the virtual tank. Logs of a real fin always contain all measured channels."""


def collect_logs(
    plant: Plant,
    config: CollectConfig,
    out: Path,
    test_plants: Sequence[Plant] | None = None,
    progress: Progress | None = None,
    metadata: JsonObject | None = None,
    overwrite: bool = False,
) -> Dataset:
    """Record random motions of `plant` into the new dataset folder `out`.

    `test_plants` are the plants of the test logs (default: `plant` for all). `metadata`, such as
    the plant's name, is added to ``dataset.json``.
    """
    plants = [plant] * config.logs + list(test_plants or [plant] * config.test_logs)
    if config.channels and not all(isinstance(each, MeasuringPlant) for each in plants):
        raise PlantError(
            f"channels: the plant {type(plant).__name__} has no method measure to record; "
            "use --channels false"
        )
    keys = []
    for part, count in (("train", config.logs), ("test", config.test_logs)):
        keys += [named_key(config.seed, f"collect/{part}/{index}") for index in range(count)]
    total_rows = len(plants) * config.rows
    finished_rows = 0

    def report(rows: int) -> None:
        nonlocal finished_rows
        finished_rows += rows
        if progress:
            progress(
                "collect", finished_rows / total_rows, f"{finished_rows:,} of {total_rows:,} rows"
            )

    logs = simulate(
        plants, keys, config.rows, config.excitation, config.batch, report, config.channels
    )
    description = {
        "configuration": config.model_dump(),
        "plant": type(plant).__name__,
        "provenance": artifacts.provenance(seed=config.seed),
        **(metadata or {}),
    }
    train = _with_exact_time(islice(logs, config.logs), "train")
    test = _with_exact_time(logs, "test")
    return write_dataset(out, train, test, description, overwrite)


def _with_exact_time(logs: Iterator[Log], part: str) -> Iterator[Log]:
    """Replace the time with exact multiples of 10 ms in float64; raises PlantError if the plant
    returns invalid times or readings."""
    for index, log in enumerate(logs):
        name = f"{part}/{index:0{DATASET_PARTS[part]}d}"
        for field, values in zip(log.reading._fields, log.reading, strict=True):
            bad = np.argwhere(~np.isfinite(values))
            if bad.size:
                raise PlantError(
                    f"log {name}, row {bad[0, 0]}: the plant's {field} is {values[tuple(bad[0])]}; "
                    "every reading must be finite under every command within the limits of the "
                    "plant"
                )
        time = np.arange(1, log.rows + 1) / RATE_HZ
        late = np.flatnonzero(np.abs(log.reading.time - time) > TICK_S / 2)
        if late.size:
            row = late[0]
            raise PlantError(
                f"log {name}, row {row}: the plant time is {log.reading.time[row]:.4f} s, expected "
                f"{time[row]:.2f} s; time must start at 0 and advance by 10 ms per tick"
            )
        yield log._replace(reading=log.reading._replace(time=time))
