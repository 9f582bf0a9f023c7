"""Record the motions of a plant as a dataset (paper Sec. III-A)."""

from pathlib import Path
from typing import Any

from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.core.randomness import key_of
from softfin.data.collect import CollectConfig, open_to_extend
from softfin.data.collect import collect as _collect
from softfin.data.excitation import Commands
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.surrogate.active import ActiveCollectConfig, chooser
from softfin.tank import Tank, sample_tank


def collect(
    plant: str | Plant, out: Path, config: CollectConfig | ActiveCollectConfig | None = None, *,
    surrogate: Path | None = None, extend: Path | None = None, overwrite: bool = False, progress: Progress = silent,
) -> Dataset:  # fmt: skip
    """Record motions of a plant as a dataset: random ones (paper Sec. III-A), or those that an ensemble chooses.

    The kind of configuration says which; an ActiveCollectConfig goes with the folder of a streaming `surrogate`. The
    dataset `extend`, of the same plant, is taken over into the new one. Test logs are random in any case; those of the
    virtual tank are recorded in perturbed tanks, those of other plants differ by seed alone.
    """
    config = config or CollectConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant)
    metadata: dict[str, Any] = {"plant": str(plant), "plant_identity": identity(moving)}
    before = None if extend is None else open_to_extend(extend, metadata, identity(moving, computed=True))
    commands: Commands = config.excitation
    metadata["commands"] = {"excitation": "random"}
    if isinstance(config, ActiveCollectConfig):
        if surrogate is None:
            raise ConfigurationError("active excitation needs an ensemble to choose the commands: give --surrogate DIR")
        commands, chosen_by = chooser(surrogate, config, Limits(*moving.limits))
        metadata["commands"] = {"excitation": "active", **chosen_by}
    elif surrogate is not None:
        raise ConfigurationError(f"surrogate {surrogate}: random excitation asks none; --excitation active does")
    others: list[Plant] | None = None
    if isinstance(moving, Tank):
        first = 0 if before is None else len(before.test)
        keys = [key_of(config.seed, f"collect/conditions/{first + i}") for i in range(config.test_logs)]
        others = [sample_tank(moving, key) for key in keys]
    return _collect(moving, config, out, others, progress, metadata, commands, before, overwrite)
