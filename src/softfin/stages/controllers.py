"""Stages that lead to a controller: map the reachable forces, find gaits, train policies (paper
Sec. III-C)."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from softfin.control.store import save_gaits
from softfin.core.action_clock import ActionClock
from softfin.core.choices import EngineName
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.gaits.force_map import MapConfig, check_star, find_force_map, load_force_map, save_map
from softfin.gaits.gait import FinForces
from softfin.gaits.reachable import PAPER_REFERENCES, PAPER_SIZED
from softfin.gaits.simulate import missing_gradient, survey
from softfin.gaits.usable import check_usable
from softfin.learning.configuration import TrainConfig, check, choose_preset, fit_to_reach
from softfin.learning.controllers import save_controller, write_learning
from softfin.learning.ray_training import check_cluster, train_on_ray
from softfin.learning.run import TrainingResult
from softfin.learning.train import find_gaits as search_gaits
from softfin.learning.train import train as train_in_process
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import find_plant, plant_name
from softfin.storage.run_directory import TRAINING_LOG, RunDirectory
from softfin.surrogate.channels import learnt_from

MakeConfig = Callable[[FinForces], TrainConfig]
"""Function that returns the configuration for the forces that a fin can make."""


def propose_clock(plant: str) -> ActionClock:
    """Return the clock for the stroke time of the fin that a surrogate was fitted to; raises
    ConfigurationError if it is unknown."""
    stroke_s = None
    if artifacts.is_kind(Path(plant), "surrogate"):
        stroke_s = artifacts.load_description(Path(plant), "surrogate").get("stroke_s")
    if stroke_s is None:
        raise ConfigurationError(
            f"--clock auto: the stroke time of {plant} is unknown; use a rate in Hz such as 3, or "
            "fit a surrogate to logs of this fin (softfin fit)"
        )
    return ActionClock.for_strokes(stroke_s)


@lock_output
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
    tolerance_n = config.tolerance(found.reachable)
    (star, warning) = check_star(found, tolerance_n)
    return {
        "map": str(out),
        "box_n": found.reachable.bounds(),
        "area_n2": found.reachable.area(),
        "nodes": errors.size,
        "held": int((errors <= tolerance_n).sum()),
        "tolerance_n": tolerance_n,
        "reach_n": found.reachable.reach_n,
        "beyond": [
            list(force) for force in PAPER_REFERENCES if not found.reachable.contains(force)
        ],
        "star_shape": star,
        "warning": warning,
    }


@lock_output
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
        config = config or MapConfig()
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


@lock_output
def train(
    plant: str | Plant,
    out: Path,
    config: TrainConfig | MakeConfig | None = None,
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

    By default, one policy is trained for all forces that the fin can produce, by gradients if the
    plant is differentiable. A configuration may also be a function of the forces that the fin can
    produce. `force_map`, the folder of a map of the plant, contains them. Without it, they are
    searched for, unless a fixed configuration starts without gaits; unreachable references are then
    used unchanged. One seed writes the controller's folder `out`; several write
    ``out/seed-N``. The `engine` trains everything in this process, as one program, or in parts on a
    Ray `cluster`. The `reason` for the algorithm is stored with the controller.
    """
    _check_engine(engine, cluster)
    moving = find_plant(plant)
    learnt = learnt_from(plant)
    loaded = forces = None
    if force_map is not None:
        loaded = load_force_map(force_map, moving, plant_name(plant)).force_map
        forces = loaded.forces
    if config is None:
        preset, reason = choose_preset(moving, "single")
        config = partial(fit_to_reach, preset)
    proposal = config
    if not isinstance(proposal, TrainConfig):
        # As long as the reach is unknown, the configuration for the paper's fin identifies the run.
        proposal = proposal(forces or FinForces(PAPER_SIZED))
    metadata = {
        "configuration": proposal.model_dump(mode="json"),
        "fitted_to_reach": proposal is not config,
        "seeds": list(seeds),
        "plant": identity(moving, computed=True),
        "map": None if loaded is None else loaded.to_dict(),
    }
    # Before the run directory is claimed: a configuration that cannot be trained leaves no trace.
    check(moving, proposal, seeds, forces)
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if run_directory.complete:
        return run_directory.finish()
    if not isinstance(config, TrainConfig):
        if forces is None:
            forces = _find_forces(moving, config, proposal, seeds, run_directory, progress)
        config = config(forces)
    origin = _origin(plant, moving, force_map)
    origin["algorithm"] = reason or f"{config.algorithm}, as configured"
    if reason is not None:
        progress("algorithm", 1.0, reason)
    if engine == "ray":
        trained = train_on_ray(moving, config, seeds, run_directory, progress, forces, cluster)
    else:
        trained = train_in_process(moving, config, seeds, run_directory, progress, forces)
    _write_controllers(out, trained, origin, learnt, run_directory)
    run_directory.finish()


def _write_controllers(
    out: Path,
    trained: TrainingResult,
    origin: JsonObject,
    learnt: JsonObject,
    run_directory: RunDirectory,
) -> None:
    """Write the controller of one seed to `out`, or those of several to ``out/seed-N``."""
    overwrite = run_directory.overwrite

    def save(folder: Path, seed: int, extra_files: Callable[[Path], None] | None = None) -> None:
        save_controller(
            folder, trained, seed, origin | {"seed": seed}, extra_files, learnt, overwrite
        )

    def keep_log(folder: Path) -> None:
        run_directory.keep_log(folder)
        write_learning(folder / TRAINING_LOG)

    def save_all(folder: Path) -> None:
        for seed in trained.seeds:
            save(folder / f"seed-{seed}", seed)
        artifacts.write_description(folder, "controllers", {"seeds": list(trained.seeds)})
        keep_log(folder)

    if len(trained.seeds) == 1:
        save(out, trained.seeds[0], keep_log)
    else:
        artifacts.write_folder(out, save_all, overwrite)


def _find_forces(
    plant: Plant,
    make_config: MakeConfig,
    proposal: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress,
) -> FinForces:
    """Survey the forces that a fin can produce, and find gaits for them if policies start from
    gaits."""
    settings = proposal.gradient.map.survey
    if missing_gradient(plant) is not None:
        settings = settings.model_copy(update={"pushes": 0})
    surveyed = survey(plant, settings, partial(progress, "survey"), proposal.task.clock)
    forces = FinForces(surveyed.reachable)
    check_usable(plant, forces.reachable)
    # References that the fin cannot reach are reported before the search for gaits, which takes
    # most of the time.
    config = make_config(forces)
    check(plant, config, seeds, forces)
    if config.begins_as_gaits:
        forces = search_gaits(plant, config, run_directory, progress, surveyed)
    return forces


def _check_engine(engine: EngineName, cluster: str | None) -> None:
    """Raise ConfigurationError if an engine or its cluster cannot be used."""
    if engine == "ray":
        check_cluster(cluster)
    elif cluster is not None:
        raise ConfigurationError(
            f"cluster {cluster}: not used by the local engine; use --engine ray, or omit --cluster"
        )
