"""Collect a dataset: commands to a plant, random or given, many logs side by side in one program (paper Sec. III-A).

A plant goes in; a dataset folder comes out, whole or not at all. Log number i of a part draws everything from the key
``collect/PART/i``, so it is the same log whatever is simulated beside it.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from jaxtyping import PRNGKeyArray

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.plant import Plant
from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.core.randomness import key_of
from softfin.data.checks.side_by_side import alike, simulate
from softfin.data.excitation import Commands, ExcitationConfig
from softfin.data.extension import extension
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.paths import PARTS

Progress = Callable[[int, int], None]
"""Called with (rows done, all rows)."""


class CollectConfig(Configuration):
    """How much is recorded, and under which commands."""

    logs: int = pydantic.Field(default=100, ge=1)
    """Logs to learn from; the paper's 100."""
    test_logs: int = pydantic.Field(default=3, ge=0)
    """Logs to score on; the paper's 3, under other conditions."""
    rows: int = pydantic.Field(default=20_000, ge=2)
    """Readings a log at 100 Hz; the paper's 20,000, which are 200 s."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Of commands and of whatever is random in the plant."""
    batch: int = pydantic.Field(default=100, ge=1)
    """Logs simulated side by side, at most; more are faster, and each takes about 30 bytes a row while it runs."""
    excitation: ExcitationConfig = ExcitationConfig()
    """The random commands."""


def collect(
    plant: Plant | Sequence[Plant],
    config: CollectConfig,
    out: Path,
    test_plant: Plant | Sequence[Plant] | None = None,
    progress: Progress | None = None,
    facts: dict[str, Any] | None = None,
    commands: Commands | None = None,
    before: Dataset | None = None,
    overwrite: bool = False,
) -> Dataset:
    """Record `plant` into the new dataset folder `out`; `facts`, say what plant it is, go into its ``dataset.json``.

    One plant serves all logs; a sequence gives each log its own, such as tanks under different conditions. Plants that
    are pytrees alike but for their arrays run side by side, others one after another. `test_plant` is for the test
    logs; without it they are recorded from `plant` too, from the first of a sequence. `commands` are for the logs to
    learn from, instead of random ones; test logs are always under random ones.

    `before` is a dataset whose logs are taken over. The new logs are numbered on from them, so that the same seed gives
    others, but those to learn from stand first: a fit holds out the last ones, and what was held out stays held out.
    """
    train = _one_a_log(plant, config.logs, "plant")
    test = _one_a_log(train[0] if test_plant is None else test_plant, config.test_logs, "test_plant")
    all_rows = (config.logs + config.test_logs) * config.rows
    done = 0

    def report(rows: int) -> None:
        nonlocal done
        done += rows
        if progress:
            progress(done, all_rows)

    held = (0, 0) if before is None else (len(before.train), len(before.test))
    described = {
        "configuration": config.model_dump(),
        "plant": type(train[0]).__name__,
        "provenance": artifacts.provenance(seed=config.seed),
    }
    train_keys, test_keys = _keys(config, "train", held[0], len(train)), _keys(config, "test", held[1], len(test))
    random = config.excitation
    if commands in (None, random) and alike(train + test):
        # One program for all.
        logs = simulate(train + test, train_keys + test_keys, config.rows, random, config.batch, report)
        learning, testing = _checked(islice(logs, len(train)), "train"), _checked(logs, "test")
    else:
        logs = simulate(train, train_keys, config.rows, commands or random, config.batch, report)
        test_logs = simulate(test, test_keys, config.rows, random, config.batch, report)
        learning, testing = _checked(logs, "train"), _checked(test_logs, "test")
    if before is None:
        return write_dataset(out, learning, testing, described | (facts or {}), overwrite)
    return write_dataset(
        out,
        chain(learning, before.load(before.train)),
        chain(before.load(before.test), testing),
        described | {"extends": extension(before)} | (facts or {}),
        overwrite,
    )


def _one_a_log(plant: Plant | Sequence[Plant], count: int, name: str) -> list[Plant]:
    if isinstance(plant, Plant):
        return [plant] * count
    if len(plant) != count:
        raise ConfigurationError(f"{name}: {len(plant)} plants for {count} logs; give one plant, or one for each log")
    return list(plant)


def _keys(config: CollectConfig, part: str, first: int, count: int) -> list[PRNGKeyArray]:
    return [key_of(config.seed, f"collect/{part}/{first + index}") for index in range(count)]


def _checked(logs: Iterator[Log], part: str) -> Iterator[Log]:
    for index, log in enumerate(logs):
        yield _checked_log(log, f"{part}/{index:0{PARTS[part]}d}")


def _checked_log(log: Log, name: str) -> Log:
    """With its time counted in float64; raises PlantError where the plant's own time or readings mean nothing."""
    time = np.arange(1, log.reading.time.shape[0] + 1) / RATE_HZ
    for field, values in zip(log.reading._fields, log.reading, strict=True):
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            raise PlantError(
                f"log {name}, row {bad[0, 0]}: the plant's {field} is {values[tuple(bad[0])]}; "
                "every reading must be finite under every command within the plant's limits"
            )
    late = np.flatnonzero(np.abs(log.reading.time - time) > TICK_S / 2)
    if late.size:
        row = late[0]
        raise PlantError(
            f"log {name}, row {row}: the plant's time is {log.reading.time[row]:.4f} s, must be {time[row]:.2f} s; "
            "time starts at 0 and each tick is 10 ms"
        )
    return Log(log.command, log.reading._replace(time=time))
