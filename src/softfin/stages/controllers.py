"""Stages that produce a controller: find gaits for the forces that a fin can produce, or train
policies (paper Sec. III-C)."""

from functools import partial
from pathlib import Path

from softfin.control.store import save_gaits
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.gaits.force_map import MapConfig, find_force_map, force_tolerance, star_warning
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.gaits.simulate import SurveyConfig, survey
from softfin.gaits.usable import check_usable
from softfin.learning.configuration import TrainConfig
from softfin.learning.controllers import save_policies
from softfin.learning.train import train_policies
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import find_plant, plant_name
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.channels import learnt_from


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
    """Find the mean forces that a fin can produce, and gaits that produce them; writes a controller
    of gaits to the folder `out`."""
    config = config or MapConfig()
    artifacts.check_vacant(out, overwrite)
    name = plant_name(plant)
    learnt = learnt_from(plant)
    plant = find_plant(plant)
    force_map = find_force_map(plant, config, partial(progress, "map"))
    reachable = force_map.reachable
    tolerance_n = force_tolerance(reachable)
    keys = {
        **learnt,
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(plant=name, plant_identity=identity(plant)),
    }
    limits = Limits(*map(float, plant.limits))
    save_gaits(out, force_map, tolerance_n, limits, keys, overwrite)
    errors = force_map.gaits.force_error()
    box = reachable.bounding_box()
    return {
        "controller": str(out),
        "box_n": (box.low, box.high),
        "area_n2": reachable.area(),
        "nodes": errors.size,
        "held": int((errors <= tolerance_n).sum()),
        "tolerance_n": tolerance_n,
        "reach_n": reachable.reach_n,
        "beyond": [list(force) for force in PAPER_REFERENCES if not reachable.contains(force)],
        "warning": star_warning(force_map, tolerance_n),
    }


@lock_output
def train(
    plant: str | Plant,
    out: Path,
    config: TrainConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Train policies in a plant, usually a surrogate, by LSTM-PPO (paper Sec. III-C); writes a
    controller to the folder `out`.

    A survey of gaits first determines the forces that the fin can produce. Returns the folder and
    the errors of the policies at the evaluation references.
    """
    config = config or TrainConfig()
    artifacts.check_vacant(out, overwrite or resume)
    name = plant_name(plant)
    learnt = learnt_from(plant)
    plant = find_plant(plant)
    metadata = {
        "configuration": config.model_dump(mode="json"),
        "seed": seed,
        "plant": identity(plant),
    }
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        # The corners are not pushed outwards, because that takes most of a survey's time and needs
        # gradients, which a user's simulator may lack. The area is about 5% smaller.
        settings = SurveyConfig(pushes=0)
        surveyed = survey(plant, settings, partial(progress, "survey"), config.task.clock)
        reachable = surveyed.reachable
        check_usable(plant, reachable)
        report = partial(progress, "train")
        trained = train_policies(plant, config, reachable, seed, run_directory, report)
        origin = artifacts.provenance(plant=name, plant_identity=identity(plant), seed=seed)
        save_policies(out, trained, origin, learnt, overwrite, run_directory.keep_log)
    run_directory.finish()
    scores = artifacts.load_description(out, "controller")["scores"]
    return {"controller": str(out), "scores": scores}
