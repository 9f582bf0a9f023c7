"""The stage that evaluates what needs no learnt controller; as the other stages, a function of folders."""

from functools import partial
from pathlib import Path
from typing import Any

from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.evaluation.baselines.baselines import BaselinesConfig, evaluate_baselines, write_baselines
from softfin.stages.train import name_of
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant


def baselines(
    plant: str | Plant,
    out: Path,
    config: BaselinesConfig | None = None,
    *,
    surrogate: str | Plant | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Evaluate a still fin, the best sine, an inverse model, random gaits; writes ``baselines.json`` to `out`.

    Sines and gaits are searched for in the `surrogate`, or in the plant itself.
    """
    config = config or BaselinesConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    searched = plant if surrogate is None else surrogate
    search_in = moving if surrogate is None else find_plant(surrogate) if isinstance(surrogate, str) else surrogate
    report = (lambda *_: None) if progress is None else partial(progress, "baselines")
    result = {
        **evaluate_baselines(moving, search_in, config, report),
        "plant": name_of(plant),
        "searched_in": name_of(searched),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=config.seed),
    }
    write_baselines(result, out, overwrite)
    return result
