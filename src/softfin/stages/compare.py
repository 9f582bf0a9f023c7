"""Compare surrogates on test logs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softfin.core.errors import ArtifactError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.surrogate.compare.compare import CompareConfig, candidates
from softfin.surrogate.compare.compare import compare as _compare
from softfin.surrogate.compare.report import write_comparison


def compare(
    surrogates: Sequence[Path],
    dataset: Path,
    out: Path | None = None,
    config: CompareConfig | None = None,
    *,
    noise_floor: str | Plant | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score surrogates on a dataset's test logs, free-running over several horizons; writes JSON and a figure.

    `noise_floor` is a plant that records the same commands once more, such as the tank: what noise and drift, twice
    over, and other conditions leave.
    """
    config = config or CompareConfig()
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    found = candidates(surrogates)
    data = Dataset.open(dataset)
    if not data.test:
        raise ArtifactError(f"{dataset}: holds no test logs to compare on; put Parquet logs into {dataset / 'test'}")
    floor: tuple[str, Plant] | None = None
    if isinstance(noise_floor, str):
        floor = noise_floor, find_plant(noise_floor)
    elif noise_floor is not None:
        floor = type(noise_floor).__name__, noise_floor

    comparison = _compare(found, list(data.load(data.test)), config, floor, progress)
    summary = {
        **comparison.summary,
        "dataset": str(dataset),
        "test_logs": len(data.test),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=config.seed, data_hash=data.data_hash),
    }
    if out is not None:
        artifacts.write_folder(out, lambda folder: write_comparison(folder, comparison, summary), overwrite)
    return summary
