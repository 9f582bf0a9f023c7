"""The stages of the main job as functions of folders: each reads what the one before wrote and writes its own.

They are the Python API that ``import softfin`` offers, and the command line is a few lines over them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from softfin import artifacts
from softfin.checkpoint import Workspace
from softfin.logs.collect import CollectConfig
from softfin.logs.collect import collect as _collect
from softfin.logs.dataset import Dataset
from softfin.plant import Plant
from softfin.plants import find_plant
from softfin.randomness import key_of
from softfin.surrogate import FitConfig, Surrogate, save_surrogate
from softfin.surrogate import import_keras as _import_keras
from softfin.surrogate.fit import fit as _fit
from softfin.surrogate.metrics import table_one
from softfin.tank import Tank, randomised

Progress = Callable[[str, float, str], None]
"""Called with what is going on, how much of it is done (0 .. 1), and the newest figures."""

TRAINING_LOG = "training"
"""Sub-folder of an artifact with ``log.jsonl`` and the event file for TensorBoard."""


def collect(
    plant: str | Plant,
    out: Path,
    config: CollectConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """Record random motions of a plant as a dataset (paper Sec. III-A).

    The test logs of the virtual tank are recorded in tanks under other conditions; other plants differ by seed alone.
    """
    config = config or CollectConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    others: list[Plant] | None = None
    if isinstance(moving, Tank):
        keys = [key_of(config.seed, f"collect/conditions/{i}") for i in range(config.test_logs)]
        others = [randomised(moving, key) for key in keys]

    def report(rows: int, of: int) -> None:
        if progress is not None:
            progress("collect", rows / of, f"{rows:,} of {of:,} rows")

    return _collect(moving, config, out, others, report, {"plant": str(plant)})


def fit(
    dataset: Path,
    out: Path,
    config: FitConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit PosNet and ForceNet to a dataset, score them on its test logs, write a surrogate; returns Table I."""
    config = config or FitConfig()
    data = Dataset.open(dataset)
    facts = {"configuration": config.model_dump(mode="json"), "seed": seed, "data_hash": data.data_hash}
    workspace = Workspace(out, facts, resume, overwrite)
    surrogate = _fit(list(data.load(data.train)), config, seed, workspace, progress)
    scores = table_one(surrogate, list(data.load(data.test))) if data.test else None
    provenance = artifacts.provenance(seed=seed, data_hash=data.data_hash, dataset=str(dataset))
    save_surrogate(out, surrogate, scores, provenance, configuration=facts["configuration"])
    workspace.finish(keep=out / TRAINING_LOG)
    return {"table_i": scores}


def import_keras(posnet: Path, forcenet: Path, scalers: Path, out: Path, *, overwrite: bool = False) -> Surrogate:
    """Two published ``.keras`` files and the JSON of their scalers become a surrogate."""
    artifacts.check_vacant(out, overwrite)
    surrogate = _import_keras(posnet, forcenet, scalers)
    sources = {"posnet": posnet.name, "forcenet": forcenet.name, "scalers": scalers.name}
    save_surrogate(out, surrogate, None, artifacts.provenance(imported_from=sources))
    return surrogate
