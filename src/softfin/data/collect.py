"""Collect a dataset: random or given commands to a plant, many logs in one program (paper Sec. III-A).

A plant goes in; a dataset folder comes out, whole or not at all. Log number i of a part draws everything from the key
``collect/PART/i``, so it does not depend on what is simulated beside it.
"""

from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.core.randomness import key_of
from softfin.data.excitation import Commands, ExcitationConfig
from softfin.data.simulate import simulate
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.paths import DATASET_PARTS


class CollectConfig(Configuration):
    """Number and length of logs, and the commands."""

    logs: int = pydantic.Field(default=100, ge=1)
    """Number of training logs; the paper's 100."""
    test_logs: int = pydantic.Field(default=3, ge=0)
    """Number of test logs; the paper's 3, in perturbed tanks."""
    rows: int = pydantic.Field(default=20_000, ge=2)
    """Readings per log at 100 Hz; the paper's 20,000, which are 200 s."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the commands and of all that is random in the plant."""
    batch: int = pydantic.Field(default=100, ge=1)
    """Most logs simulated side by side; more are faster, and each takes about 30 bytes a row while it runs."""
    excitation: ExcitationConfig = ExcitationConfig()
    """The random commands."""


def collect(
    plant: Plant,
    config: CollectConfig,
    out: Path,
    test_plants: Sequence[Plant] | None = None,
    progress: Progress | None = None,
    metadata: dict[str, Any] | None = None,
    commands: Commands | None = None,
    before: Dataset | None = None,
    overwrite: bool = False,
) -> Dataset:
    """Record `plant` into the new dataset folder `out`; `metadata`, such as its name, goes into ``dataset.json``.

    `test_plants` are for the test logs, one for each; without them these are recorded from `plant`, too. `commands` are
    for the training logs, instead of random ones; test logs are always under random ones.

    `before` is a dataset whose logs are taken over. The new logs are numbered on from them, so that the same seed gives
    others, but the new training logs stand first: a fit holds out the last ones, so the same ones stay held out.
    """
    train, test = [plant] * config.logs, list(test_plants or [plant] * config.test_logs)
    all_rows, done = (config.logs + config.test_logs) * config.rows, 0

    def report(rows: int) -> None:
        nonlocal done
        done += rows
        if progress:
            progress("collect", done / all_rows, f"{done:,} of {all_rows:,} rows")

    first, first_test = (0, 0) if before is None else (len(before.train), len(before.test))
    train_keys = [key_of(config.seed, f"collect/train/{first + index}") for index in range(config.logs)]
    test_keys = [key_of(config.seed, f"collect/test/{first_test + index}") for index in range(config.test_logs)]
    random = config.excitation
    if commands in (None, random):
        # One program for all.
        logs = test_logs = simulate(train + test, train_keys + test_keys, config.rows, random, config.batch, report)
    else:
        logs = simulate(train, train_keys, config.rows, commands, config.batch, report)
        test_logs = simulate(test, test_keys, config.rows, random, config.batch, report)
    new_train, new_test = _with_exact_time(islice(logs, len(train)), "train"), _with_exact_time(test_logs, "test")
    description = {
        "configuration": config.model_dump(),
        "plant": type(plant).__name__,
        "provenance": artifacts.provenance(seed=config.seed),
    }
    if before is not None:
        new_train, new_test = chain(new_train, before.load(before.train)), chain(before.load(before.test), new_test)
        earlier = {name: value for name, value in before.description.items() if name not in ("files", "data_hash")}
        counts = {"logs": len(before.train), "test_logs": len(before.test)}
        extends = {"dataset": str(before.path), "data_hash": before.data_hash, **counts, "description": earlier}
        description["extends"] = extends
    return write_dataset(out, new_train, new_test, description | (metadata or {}), overwrite)


def open_to_extend(path: Path, metadata: dict[str, Any], *earlier: str) -> Dataset:
    """Open a dataset to which logs are added of the plant with the ``plant`` and ``plant_identity`` in `metadata`.

    `earlier` are identities that earlier versions wrote for it.

    Raises:
        ArtifactError: it is not a dataset, or damaged.
        ConfigurationError: it is of another plant, or its plant is not known.
    """
    before = Dataset.open(path)
    recorded = {name: before.description.get(name) for name in ("plant", "plant_identity")}
    # Names may differ for one plant, and one name, as that of a file, may come to stand for another.
    decisive = "plant" if recorded["plant_identity"] is None else "plant_identity"
    if recorded[decisive] not in (metadata[decisive], *earlier):
        now = str(metadata["plant"])
        raise ConfigurationError(
            f"{path}: recorded of {recorded['plant'] or 'a plant without a name'}, not of {now} as it is now; logs of "
            f'two plants do not mix: collect anew (or, if its dataset.json has no name, write "plant": "{now}" into it)'
        )
    return before


def _with_exact_time(logs: Iterator[Log], part: str) -> Iterator[Log]:
    """Count the time in float64; raises PlantError where the plant's own time or readings are not valid."""
    for index, log in enumerate(logs):
        name = f"{part}/{index:0{DATASET_PARTS[part]}d}"
        for field, values in zip(log.reading._fields, log.reading, strict=True):
            bad = np.argwhere(~np.isfinite(values))
            if bad.size:
                raise PlantError(
                    f"log {name}, row {bad[0, 0]}: the plant's {field} is {values[tuple(bad[0])]}; "
                    "every reading must be finite under every command within the plant's limits"
                )
        time = np.arange(1, log.reading.time.shape[0] + 1) / RATE_HZ
        late = np.flatnonzero(np.abs(log.reading.time - time) > TICK_S / 2)
        if late.size:
            row = late[0]
            raise PlantError(
                f"log {name}, row {row}: the plant's time is {log.reading.time[row]:.4f} s, must be {time[row]:.2f} s; "
                "time starts at 0 and each tick is 10 ms"
            )
        yield Log(log.command, log.reading._replace(time=time))
