"""Stages that lead to a controller: map the reachable forces, find gaits, train policies (paper
Sec. III-C)."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from softfin.control.store import save_gaits
from softfin.core.choices import EngineName
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.gaits.force_map import MapConfig, check_star, find_force_map, load_force_map, save_map
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.learning.configuration import TrainConfig, check, choose_preset
from softfin.learning.controllers import save_controller, write_learning
from softfin.learning.ray_training import check_cluster, train_on_ray
from softfin.learning.train import train as train_in_process
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant, plant_name
from softfin.storage.run_directory import TRAINING_LOG, RunDirectory
from softfin.surrogate.channels import learnt_from
from softfin.task.references import PAPER_RANGE


def map_forces(
    plant: str | Plant,
    out: Path,
    config: MapConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Find the mean forces that a fin can produce, their Sobolev terms and gaits for them; writes
    the folder `out`."""
    config = config or MapConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant)
    found = find_force_map(moving, config, partial(progress, "map"))
    save_map(
        out,
        found,
        config,
        Limits(*map(float, moving.limits)),
        _origin(plant, moving, None),
        overwrite,
    )
    errors = found.gaits.force_error()
    (star, warning) = check_star(found, config.tolerance_n)
    return {
        "map": str(out),
        "box_n": found.reachable.bounds(),
        "area_n2": found.reachable.area(),
        "nodes": errors.size,
        "held": int((errors <= config.tolerance_n).sum()),
        "beyond": [
            list(force) for force in PAPER_REFERENCES if not found.reachable.contains(force)
        ],
        "star_shape": star,
        "warning": warning,
    }


def find_gaits(
    plant: str | Plant,
    out: Path,
    config: MapConfig | None = None,
    *,
    force_map: Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> None:
    """Find gaits for a grid of reference forces and write them as a controller to the folder `out`.

    `force_map`, the folder of a map, already contains gaits for its own grid.
    """
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant)
    if force_map is None:
        config = config or MapConfig(box=PAPER_RANGE)
        found = find_force_map(moving, config, partial(progress, "gaits"))
    elif config is None:
        loaded = load_force_map(force_map, moving, plant_name(plant))
        found = loaded.force_map
        config = loaded.config
    else:
        raise ConfigurationError(
            f"map {force_map}: its grid is fixed; omit the configuration and the range"
        )
    origin = _origin(plant, moving, force_map)
    save_gaits(
        out,
        found,
        config,
        Limits(*map(float, moving.limits)),
        origin,
        None,
        learnt_from(plant),
        overwrite,
    )


def _origin(plant: str | Plant, moving: Plant, force_map: Path | None) -> JsonObject:
    made_with = {} if force_map is None else {"map": str(force_map)}
    return artifacts.provenance(
        plant=plant_name(plant), plant_identity=identity(moving), **made_with
    )


def train(
    plant: str | Plant,
    out: Path,
    config: TrainConfig | None = None,
    *,
    force_map: Path | None = None,
    seeds: Sequence[int] = (0,),
    engine: EngineName = "local",
    cluster: str | None = None,
    reason: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> None:
    """Train controllers in a plant, usually a surrogate, by LSTM-PPO (paper Sec. III-C) or by
    gradients.

    By default, a grid over the paper's cells is trained, by gradients if the plant is
    differentiable. `force_map`, the folder of a map of the plant, provides the reachable forces and
    gaits. Without it, the fin is mapped only if policies start from gaits; otherwise unreachable
    references are used unchanged. One seed writes the controller's folder `out`; several write
    ``out/seed-N``. The `engine` trains everything in this process, as one program, or in parts on a
    Ray `cluster`. The `reason` for the algorithm is stored with the controller.
    """
    _check_engine(engine, cluster)
    moving = find_plant(plant)
    if config is None:
        config, reason = choose_preset(moving)
    can = (
        None
        if force_map is None
        else load_force_map(force_map, moving, plant_name(plant)).force_map
    )
    origin = _origin(plant, moving, force_map)
    learnt = learnt_from(plant)
    origin["algorithm"] = reason or f"{config.algorithm}, as configured"
    metadata = {
        "configuration": config.model_dump(mode="json"),
        "seeds": list(seeds),
        "plant": identity(moving, computed=True),
        "map": None if can is None else can.to_dict(),
    }
    # Before the run directory is claimed: a configuration that cannot be trained leaves no trace.
    check(moving, config, seeds, can)
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if run_directory.complete:
        return run_directory.finish()
    if reason is not None:
        progress("algorithm", 1.0, reason)
    if engine == "ray":
        trained = train_on_ray(moving, config, seeds, run_directory, progress, can, cluster)
    else:
        trained = train_in_process(moving, config, seeds, run_directory, progress, can)

    def save(folder: Path, seed: int, extra_files: Callable[[Path], None] | None = None) -> None:
        save_controller(
            folder, trained, seed, origin | {"seed": seed}, extra_files, learnt, overwrite
        )

    def keep_log(folder: Path) -> None:
        run_directory.keep_log(folder)
        write_learning(folder / TRAINING_LOG)

    def save_all(folder: Path) -> None:
        for seed in seeds:
            save(folder / f"seed-{seed}", seed)
        artifacts.write_description(folder, "controllers", {"seeds": list(seeds)})
        keep_log(folder)

    if len(seeds) == 1:
        save(out, seeds[0], keep_log)
    else:
        artifacts.write_folder(out, save_all, overwrite)
    run_directory.finish()


def _check_engine(engine: EngineName, cluster: str | None) -> None:
    """Raise ConfigurationError if an engine or its cluster cannot be used."""
    if engine == "ray":
        check_cluster(cluster)
    elif cluster is not None:
        raise ConfigurationError(
            f"cluster {cluster}: not used by the local engine; use --engine ray, or omit --cluster"
        )
