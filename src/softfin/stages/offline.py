"""The stages of the main job as functions of folders: each reads what the one before wrote and writes its own.

They are the Python API that ``import softfin`` offers, and the command line is a few lines over them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from softfin.control.references import resolve_reference
from softfin.control.store import load_controller, save_gaits
from softfin.core.choices import EngineName, Split
from softfin.core.errors import ArtifactError, ConfigurationError, LogError, PlantError
from softfin.core.plant import EnsemblePlant, Plant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import Limits
from softfin.core.randomness import key_of
from softfin.data.checks.inspection import Inspection
from softfin.data.checks.report import write_inspection
from softfin.data.collect import CollectConfig, open_to_extend
from softfin.data.collect import collect as _collect
from softfin.data.excitation import Commands
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import check_issues
from softfin.data.recordings import OpenedLogs, check_train, open_logs
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, write_evaluation
from softfin.evaluation.evaluate import evaluate as _evaluate
from softfin.evaluation.experiment import Subject
from softfin.evaluation.view import ViewConfig
from softfin.evaluation.view.video import ticks_of
from softfin.evaluation.view.view import draw, footage_of, title_of
from softfin.gaits.figure import write_map
from softfin.gaits.force_map import MapConfig, check_star
from softfin.gaits.force_map import map_forces as _map_forces
from softfin.gaits.map_store import load_force_map
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.learning.configuration import TrainConfig, check, choose_preset
from softfin.learning.controllers import save_controller
from softfin.learning.figure import REFINED, write_learning
from softfin.learning.jobs import default_split, find_engine, train_jobs
from softfin.learning.refine import check_refinable, train_refined
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.paths import check_view
from softfin.storage.registry import find_plant
from softfin.storage.run_directory import TRAINING_LOG, Workspace
from softfin.surrogate import (
    AutoConfig,
    FitConfig,
    StreamingConfig,
    Surrogate,
    load_surrogate,
    save_surrogate,
)
from softfin.surrogate import import_keras as _import_keras
from softfin.surrogate.active import ActiveCollectConfig, chooser
from softfin.surrogate.channels import SKIPPED, command_limits, learnt_from, training_range
from softfin.surrogate.compare.compare import CompareConfig, candidates
from softfin.surrogate.compare.compare import compare as _compare
from softfin.surrogate.compare.metrics import measured_ranges, table_one
from softfin.surrogate.compare.report import write_comparison
from softfin.surrogate.selection import fit_any
from softfin.surrogate.training import check_lengths
from softfin.tank import DomainRandomization, RandomizedTank, Tank, sample_tank
from softfin.tank.calibration.calibrate import calibrate as _calibrate
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.material import material
from softfin.tank.calibration.report import write_calibration
from softfin.task.references import PAPER_RANGE

"""Called with what is going on, how much of it is done (0 .. 1), and the newest figures."""


def collect(
    plant: str | Plant,
    out: Path,
    config: CollectConfig | ActiveCollectConfig | None = None,
    *,
    surrogate: Path | None = None,
    extend: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """Record motions of a plant as a dataset: random ones (paper Sec. III-A), or those that an ensemble chooses.

    The kind of configuration says which; an ActiveCollectConfig goes with the folder of a streaming `surrogate`. The
    dataset `extend`, of the same plant, is taken over into the new one. Test logs are random in any case; those of the
    virtual tank are recorded in tanks under other conditions, those of other plants differ by seed alone.
    """
    config = config or CollectConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    metadata: dict[str, Any] = {"plant": str(plant), "plant_identity": identity(moving)}
    before = None if extend is None else open_to_extend(extend, metadata)
    commands, metadata["commands"] = _commands(config, surrogate, Limits(*moving.limits))
    others: list[Plant] | None = None
    if isinstance(moving, Tank):
        first = 0 if before is None else len(before.test)
        keys = [key_of(config.seed, f"collect/conditions/{first + i}") for i in range(config.test_logs)]
        others = [sample_tank(moving, key) for key in keys]

    def report(rows: int, of: int) -> None:
        if progress is not None:
            progress("collect", rows / of, f"{rows:,} of {of:,} rows")

    return _collect(moving, config, out, others, report, metadata, commands, before, overwrite)


def _commands(
    config: CollectConfig | ActiveCollectConfig, surrogate: Path | None, limits: Limits
) -> tuple[Commands, dict[str, Any]]:
    if not isinstance(config, ActiveCollectConfig):
        if surrogate is not None:
            raise ConfigurationError(f"surrogate {surrogate}: random excitation asks none; --excitation active does")
        return config.excitation, {"excitation": "random"}
    if surrogate is None:
        raise ConfigurationError("active excitation needs an ensemble to choose the commands: give --surrogate DIR")
    commands, chosen_by = chooser(surrogate, config, limits)
    return commands, {"excitation": "active", **chosen_by}


def inspect_logs(
    path: Path,
    out: Path | None = None,
    config: ImportConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Find what is wrong with recordings; writes ``inspection.json`` and a figure to `out`."""
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    config = config or ImportConfig()
    opened = open_logs(path, config, progress)
    metadata = {
        "source": str(path),
        "options": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(data_hash=opened.data_hash),
    }
    if out is None:
        return {**opened.inspection.to_dict(), **metadata}
    return write_inspection(opened.inspection, opened.logs, out, metadata, overwrite)


def import_logs(
    path: Path,
    out: Path,
    config: ImportConfig | None = None,
    *,
    ignore_errors: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> tuple[Dataset, Inspection]:
    """Turn recordings of any kind into a dataset; raises LogError where they have errors, unless these are ignored."""
    artifacts.check_vacant(out, overwrite)
    opened = open_logs(path, config or ImportConfig(), progress)
    check_train(opened, str(path))
    check_issues(opened.issues, str(path), ignore_errors)
    metadata = {**opened.metadata, "ignore_errors": ignore_errors, "provenance": artifacts.provenance()}
    return write_dataset(out, opened.train, opened.test, metadata, overwrite), opened.inspection


def fit(
    dataset: Path,
    out: Path,
    config: FitConfig | StreamingConfig | AutoConfig | None = None,
    *,
    logs: ImportConfig | None = None,
    ignore_errors: bool = False,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit a surrogate to logs, score it on their test logs, write it; returns Table I, counts of issues, a caveat.

    The kind of configuration says which model: the paper's nets, streaming nets, or what is best on held-out logs.
    `dataset` is a dataset's folder, or recordings of any other kind, read as `logs` says; raises LogError where these
    have errors, unless these are ignored, now or when the dataset was imported.
    """
    config = config or StreamingConfig()
    artifacts.check_vacant(out, overwrite or resume)
    opened = _opened(dataset, logs, ignore_errors, progress)
    facts = {"configuration": config.model_dump(mode="json"), "seed": seed, "data_hash": opened.data_hash}
    workspace = Workspace(out, facts, resume, overwrite)
    if not workspace.complete:
        if problem := command_limits(opened.train).problem(one_velocity=True):
            raise LogError(f"{dataset}: the commands to learn from: {problem}; are they in degrees? see --angles deg")
        test = opened.test
        check_lengths(test, SKIPPED, "test")
        if test:
            measured_ranges(test)
        fitted, evidence = fit_any(opened.train, config, seed, workspace, progress)
        provenance = artifacts.provenance(
            seed=seed, data_hash=opened.data_hash, dataset=str(dataset), **opened.metadata
        )
        save_surrogate(
            out, fitted, table_one(fitted, test) if test else None, provenance,
            extra_files=workspace.keep_log, overwrite=overwrite, configuration=facts["configuration"],
            training_range=training_range(opened.train), fin=_fin_of(dataset),
            **({} if evidence is None else {"candidates": evidence}),
        )  # fmt: skip
    workspace.finish()
    description, surrogate = artifacts.load_description(out, "surrogate"), load_surrogate(out)
    summary = opened.inspection.summary()
    return {
        "model": surrogate.model,
        "table_i": description["scores"],
        "candidates": description.get("candidates"),
        "issues": summary["counts"],
        "columns": summary["columns"],
        "caveat": surrogate.interval.caveat() if isinstance(surrogate, EnsemblePlant) else None,
    }


def _opened(dataset: Path, config: ImportConfig | None, ignore_errors: bool, progress: Progress | None) -> OpenedLogs:
    opened = open_logs(dataset, config, progress)
    check_train(opened, str(dataset))
    known = artifacts.load_description(dataset, "dataset") if artifacts.is_kind(dataset, "dataset") else None
    # Datasets of softfin before 0.2 have "accepted" in place of "ignore_errors".
    were_ignored = known is not None and True in (known.get("ignore_errors"), known.get("accepted"))
    check_issues(opened.issues, str(dataset), ignore_errors or were_ignored)
    # A dataset's own folder has its metadata.
    return dataclasses.replace(opened, metadata={"logs": opened.metadata} if known is None else {})


def _fin_of(dataset: Path) -> str | None:
    """The name that a rig gave to its fin, where a dataset was recorded on one."""
    if not artifacts.is_kind(dataset, "dataset"):
        return None
    fin = artifacts.load_description(dataset, "dataset").get("fin")
    return None if fin is None else str(fin)


def calibrate(
    data: str | Path | Plant,
    out: Path,
    config: CalibrateConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit the virtual tank to a dataset or to a plant; writes ``calibration.json``, ``tank.yaml`` and figures."""
    config = config or CalibrateConfig()
    artifacts.check_vacant(out, overwrite or resume)
    found = material(data, config, seed)
    facts = {"configuration": config.model_dump(mode="json"), "seed": seed, **found.facts}
    workspace = Workspace(out, facts, resume, overwrite)
    if workspace.complete:
        workspace.finish()
        return artifacts.load_description(out, "calibration")
    calibration = _calibrate(config, found.train, found.test, seed, workspace, progress)
    named = str(data) if isinstance(data, str | Path) else type(data).__name__
    origin = artifacts.provenance(seed=seed, data=named, **found.facts)
    written = {"configuration": facts["configuration"], "provenance": origin}
    summary = write_calibration(calibration, found.beats, out, written, workspace.keep_log, overwrite)
    workspace.finish()
    return summary


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
    facts = {
        "dataset": str(dataset),
        "test_logs": len(data.test),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=config.seed, data_hash=data.data_hash),
    }
    return {**comparison.summary(), **facts} if out is None else write_comparison(comparison, out, facts, overwrite)


def import_keras(posnet: Path, forcenet: Path, scalers: Path, out: Path, *, overwrite: bool = False) -> Surrogate:
    """Two published ``.keras`` files and the JSON of their scalers become a surrogate."""
    artifacts.check_vacant(out, overwrite)
    surrogate = _import_keras(posnet, forcenet, scalers)
    sources = {"posnet": posnet.name, "forcenet": forcenet.name, "scalers": scalers.name}
    save_surrogate(out, surrogate, None, artifacts.provenance(imported_from=sources), overwrite=overwrite)
    return surrogate


def map_forces(
    plant: str | Plant,
    out: Path,
    config: MapConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Which mean forces a fin can make, at what Sobolev cost, and the gaits that make them; writes the folder `out`."""
    config = config or MapConfig()
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    known = _map_forces(moving, config, None if progress is None else partial(progress, "map"))
    write_map(out, known, config, Limits(*map(float, moving.limits)), _origin(plant, moving), overwrite)
    missed, star = known.gaits.force_error(), check_star(known, config.tolerance_n)
    return {
        "map": str(out),
        "box_n": known.reachable.bounds(),
        "area_n2": known.reachable.area(),
        "nodes": missed.size,
        "held": int((missed <= config.tolerance_n).sum()),
        "beyond": [list(force) for force in PAPER_REFERENCES if not known.reachable.contains(force)],
        "star_shape": star._asdict(),
        "warning": star.warning,
    }


def find_gaits(
    plant: str | Plant,
    out: Path,
    config: MapConfig | None = None,
    *,
    known: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Find the gaits of a lattice of reference forces and write them as a controller, the folder `out`.

    The folder of a map, `known`, has them already, over its own lattice.
    """
    artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    if known is None:
        config = config or MapConfig(box=PAPER_RANGE)
        found = _map_forces(moving, config, None if progress is None else partial(progress, "gaits"))
    elif config is None:
        loaded = load_force_map(known, moving, _named(plant))
        found, config = loaded.force_map, loaded.config
    else:
        raise ConfigurationError(f"map {known}: its lattice is made; give no configuration or range beside it")
    origin = _origin(plant, moving, **({} if known is None else {"map": str(known)}))
    save_gaits(out, found, config, Limits(*map(float, moving.limits)), origin, None, learnt_from(plant), overwrite)


def _origin(plant: str | Plant, moving: Plant, **facts: Any) -> dict[str, Any]:
    return artifacts.provenance(plant=_named(plant), plant_identity=identity(moving), **facts)


def _named(plant: str | Plant) -> str:
    return plant if isinstance(plant, str) else type(plant).__name__


def train(
    plant: str | Plant,
    out: Path,
    config: TrainConfig | None = None,
    *,
    known: Path | None = None,
    seeds: Sequence[int] = (0,),
    refine: int = 0,
    engine: EngineName = "local",
    split: Split | None = None,
    cluster: str | None = None,
    reason: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Train controllers inside a plant, as a rule a surrogate: by LSTM-PPO (paper Sec. III-C) or by gradients.

    Without a configuration it is a grid over the paper's cells, by gradients wherever the plant has them. The folder of
    a map of the plant, `known`, says what the fin can do and saves the search for gaits; without, only training by
    gradients that begins as gaits looks for it, and references beyond reach are trained for as they are.
    One seed writes the controller's folder `out`; several are written as ``out/seed-N``. All is one program, unless
    it is `split` into jobs; the `engine` does these one after the other, or all at once on a Ray `cluster`. A grid's
    worst cells are split until there are `refine` more, whose policies go on from their cell's, in this process.
    The `reason` for the algorithm is kept with the controller.
    """
    working, split = find_engine(engine, cluster), split or default_split(engine, seeds)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    if config is None:
        config, reason = choose_preset(moving)
    check_refinable(config, refine)
    can = None if known is None else load_force_map(known, moving, _named(plant)).force_map
    origin, learnt = _origin(plant, moving, **({} if known is None else {"map": str(known)})), learnt_from(plant)
    origin["algorithm"] = reason or f"{config.algorithm}, as configured"
    facts = {
        "configuration": config.model_dump(mode="json"),
        "seeds": list(seeds),
        "plant": origin["plant_identity"],
        "split": split,
        "refine": refine,
        "map": None if can is None else can.to_dict(),
    }
    check(moving, config, seeds, can)
    workspace = Workspace(out, facts, resume, overwrite)
    if workspace.complete:
        return workspace.finish()
    if progress is not None and reason is not None:
        progress("algorithm", 1.0, reason)
    trained = train_jobs(moving, config, seeds, workspace, progress, engine=working, split=split, force_map=can)
    if refine:
        trained, parents = train_refined(moving, trained, refine, workspace.part(REFINED), progress)
        origin |= {"refined_from": [cell.model_dump(mode="json") for cell in config.cells], "parents": list(parents)}

    def save(folder: Path, seed: int, also: Callable[[Path], None] | None = None) -> None:
        save_controller(folder, trained, seed, origin | {"seed": seed}, also, learnt, overwrite)

    def keep_log(folder: Path) -> None:
        workspace.keep_log(folder)
        write_learning(folder / TRAINING_LOG)

    def save_all(folder: Path) -> None:
        for seed in seeds:
            save(folder / f"seed-{seed}", seed)
        (folder / "controllers.json").write_text(artifacts.dump_json({"seeds": list(seeds)}))
        keep_log(folder)

    if len(seeds) == 1:
        save(out, seeds[0], keep_log)
    else:
        artifacts.write_folder(out, save_all, overwrite)
    workspace.finish()


def evaluate(
    controller: Path,
    plant: str | Subject,
    out: Path | None = None,
    config: EvaluateConfig | None = None,
    *,
    spread: float | int | DomainRandomization | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Judge a controller on a plant (paper Sec. IV-B, Table II); writes ``evaluation.json`` and figures to `out`.

    With `spread` the plant must be a tank, and every repetition is run in another one, drawn about it; 0 is the tank.
    """
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    widths = DomainRandomization.of(float(spread)) if isinstance(spread, int | float) else spread
    if widths is not None:
        if not isinstance(moving, Tank):
            raise ConfigurationError(f"spread {spread}: {plant} is no tank, so there are no others like it to draw")
        # Without a spread the sensor's noise is the tank's own, too.
        moving = moving if widths.is_none else RandomizedTank(moving, widths)
    evaluation = judged(controller, moving, config or EvaluateConfig(), str(plant))
    if out is None:
        return evaluation.summary()
    facts = {"controller": str(controller), "kind": kind_of(controller), "plant": str(plant),
             "spread": None if widths is None else widths.model_dump(mode="json")}  # fmt: skip
    return write_evaluation(evaluation, out, facts, overwrite)


def view(
    plant: str | Plant,
    out: Path,
    config: ViewConfig | None = None,
    *,
    controller: Path | None = None,
    reference: tuple[float, float] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Show a plant in motion as a .gif, .mp4, .html or .png, beating or held to a `reference` [N] by a controller."""
    config = config or ViewConfig()
    check_view(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    holding = None if controller is None else load_controller(controller)
    if (holding is None) != (reference is None):
        raise ConfigurationError("a controller and a reference belong together; give both or none")
    if holding is not None and config.random:
        raise ConfigurationError("random commands and a controller at once; give one of them")
    warnings: list[str] = []
    if controller is not None and holding is not None and reference is not None:
        pairs = [resolve_reference(holding, asked, strict=False) for asked in (reference, *config.then)]
        reference, *following = (force for force, _ in pairs)
        config = config.merged({"then": following}, "view")
        warnings = [said for _, said in pairs if said is not None]
        _check_limits(holding.limits, Limits(*moving.limits), controller, plant)
    named = plant if isinstance(plant, str) else type(plant).__name__
    title = title_of(named, config, reference)

    def report(done: float) -> None:
        if progress is not None:
            progress("view", done, "")

    report(0.0)
    footage = footage_of(moving, config, holding, reference)
    draw(footage, out, title, config, report)
    ticks = len(footage.shape)
    films = out.suffix in (".gif", ".mp4")
    return {
        "view": str(out),
        "title": title,
        "seconds": config.seconds,
        "frames": len(ticks_of(ticks, config.frames_per_second)) if films else None,
        "mean_force_n": [round(float(force), 4) for force in footage.reading.force.mean(axis=0)],
        "shape_known": footage.shape_known,
        "warning": "; ".join(warnings) or None,
    }


def kind_of(controller: Path) -> str:
    """``single``, ``grid`` or ``gaits``."""
    kind: str = artifacts.load_description(controller, "controller")["controller"]
    return kind


def judged(controller: Path, plant: str | Subject, config: EvaluateConfig, named: str | None = None) -> Evaluation:
    """A controller's experiments on a plant, not yet written."""
    moving = find_plant(plant) if isinstance(plant, str) else plant
    holding = load_controller(controller)
    _check_limits(holding.limits, Limits(*moving.limits), controller, named or plant)
    return _evaluate(holding, moving, config)


def _check_limits(asked: Limits, taken: Limits, controller: Path, plant: str | Subject) -> None:
    for low, high in (("angle_min", "angle_max"), ("velocity_min", "velocity_max")):
        ours, theirs = ((getattr(limits, low), getattr(limits, high)) for limits in (asked, taken))
        tolerance = 1e-3 * (theirs[1] - theirs[0])
        if ours[0] < theirs[0] - tolerance or ours[1] > theirs[1] + tolerance:
            quantity = low.removesuffix("_min")
            raise PlantError(
                f"{controller}: commands a {quantity} of {ours[0]:.3g} .. {ours[1]:.3g}; {plant} takes "
                f"{theirs[0]:.3g} .. {theirs[1]:.3g}; train it in a surrogate of this plant"
            )
