"""Record the motions of a plant as a dataset (paper Sec. III-A)."""

from pathlib import Path

from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.randomness import named_key
from softfin.data.collect import CollectConfig, collect_logs
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import find_plant
from softfin.tank import Tank, sample_tank


@lock_output
def collect(
    plant: str | Plant,
    out: Path,
    config: CollectConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Dataset:
    """Record random motions of a plant as a dataset (paper Sec. III-A).

    For the virtual tank, each test log is recorded in a perturbed tank. For other plants, test logs
    differ only in their seed.
    """
    config = config or CollectConfig()
    artifacts.check_vacant(out, overwrite)
    simulated = find_plant(plant)
    test_plants: list[Plant] = [simulated] * config.test_logs
    if isinstance(simulated, Tank):
        keys = [
            named_key(config.seed, f"collect/conditions/{index}")
            for index in range(config.test_logs)
        ]
        test_plants = [sample_tank(simulated, key) for key in keys]
    metadata = {
        "plant": str(plant),
        "plant_identity": identity(simulated),
        "commands": {"excitation": "random"},
    }
    return collect_logs(simulated, config, out, test_plants, progress, metadata, overwrite)
