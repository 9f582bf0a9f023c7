"""The complete pipeline in one run: a sequence of stages, each with its own folder, followed by a
report.

Stages whose folder exists are skipped, so that an interrupted run can be resumed.
"""

import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from softfin.core.choices import PolicyLayout, ReproducePreset
from softfin.core.errors import ArtifactError, RunError
from softfin.core.option_types import DIR, HIDDEN, PLANT, PathLike
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.core.seeds import check_seed
from softfin.data.importing.importing import ImportConfig
from softfin.stages.collect import collect
from softfin.stages.controllers import map_forces, train
from softfin.stages.evaluation import evaluate
from softfin.stages.explore import explore
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import TANK, check_plant, is_surrogate

if TYPE_CHECKING:
    from softfin.evaluation.results import EvaluationSummary, RunResults, StageRow

REPRODUCTION_KIND = "reproduction"
RESULTS = "results.json"
PAGE = "explore.html"

Changes = Mapping[str, Any]
"""Changes to the default configuration of a stage."""


class Preset(NamedTuple):
    """The stages of a run."""

    policies: Mapping[PolicyLayout, Changes]
    """Policies to train; a gait controller is always created."""
    model: str = "streaming"
    collect: Changes = MappingProxyType({})
    fit: Changes = MappingProxyType({})
    gaits: Changes = MappingProxyType({})
    evaluate: Changes = MappingProxyType({})
    """Changes to the experiments in the plant (without and with force feedback) and in the
    surrogate."""
    moving: bool = True
    """Whether to also evaluate a reference that steps from one side to the other, and controllers
    with force feedback."""
    num_seeds: int = 1
    """Number of policies trained per kind, from consecutive seeds; confidence intervals are over
    these seeds."""


PRESETS: Mapping[ReproducePreset, Preset] = {
    "paper": Preset(
        model="paper",
        # With so few actions, more updates per rollout are needed.
        policies={
            "single": {
                "range": "paper",
                "steps": 30_000,
                "ppo": {"num_envs": 32, "num_epochs": 8},
            },
            "grid": {
                "range": "paper",
                "steps": 10_000,
                "ppo": {"num_envs": 16, "num_epochs": 10},
            },
        },
        moving=False,
        num_seeds=5,
    ),
    "demo": Preset(
        collect={"logs": 10, "test_logs": 1, "rows": 6_000},
        fit={"members": 3, "drive_updates": 200, "force_updates": 400},
        policies={"single": {}},
    ),
    "tiny": Preset(
        collect={"logs": 3, "test_logs": 1, "rows": 1500},
        fit={
            "members": 2,
            "drive_updates": 20,
            "force_updates": 20,
            "batch": 8,
            "ticks": 200,
        },
        gaits={"spacing_n": 1.7, "survey": {"pushes": 1}, "gaits": {"steps": 2}},
        policies={
            "single": {"steps": 960, "num_evaluations": 1},
            "grid": {"steps": 960, "num_evaluations": 2},
        },
        evaluate={"seconds": 6},
        num_seeds=2,
    ),
}
"""``paper`` uses the full data and budgets of the paper and adds gaits. ``demo`` fits a streaming
surrogate to ten minutes of data and adds gaits and a single policy, in two minutes. ``tiny`` only
checks that every stage works."""

ONE_STEP = {"time_s": (0, 10), "force_n": ((2, -1), (2, 1))}
"""Moving reference: one step from one side to the other."""


class Stage(NamedTuple):
    """One stage of a run."""

    name: str
    what: str
    """Description of the result."""
    result: Path
    """File or folder of the result; if it exists, the stage is skipped."""
    work: Callable[..., object]
    """Function that runs the stage, with the argument `progress`."""


def demo(
    *,
    out: Annotated[PathLike, DIR] = Path("runs/demo"),
    quick: bool = False,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Run every stage on the virtual tank in a few minutes: collect, fit, train, evaluate. Writes a
    report and a page for trying the controllers.

    Args:
        out: Output folder.
        quick: Finish in one minute: run every stage, but with little training.
        seed: Seed for data and training.
        resume: Continue a stopped run.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        The contents of results.json.

    Example:
        >>> softfin.demo(out="demo", quick=True)
    """
    return reproduce(
        out=out,
        preset="tiny" if quick else "demo",
        seed=seed,
        resume=resume,
        overwrite=overwrite,
        progress=progress,
    )


@lock_output
def reproduce(
    *,
    out: Annotated[PathLike, DIR],
    preset: ReproducePreset = "paper",
    plant: Annotated[str, PLANT] = TANK,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Run every stage of the paper: collect, fit, train, evaluate. Writes its tables and figures, a
    report, and a page for trying the controllers.

    Args:
        out: Output folder.
        preset: paper (hours), demo (minutes), or tiny, which only shows that everything works.
        plant: The fin: tank, package.module:plant, or a surrogate folder, which skips collect and
            fit.
        seed: First seed.
        resume: Continue a stopped run.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        The contents of results.json.

    Example:
        >>> softfin.reproduce(out="run", preset="demo")
    """
    out = Path(out)
    check_seed(seed)
    check_plant(plant)
    _claim(out, plant, preset, seed, resume, overwrite)
    if (out / RESULTS).is_file():
        # The run is complete.
        complete: Any = artifacts.read_json(out / RESULTS, "repeat the run with --overwrite")
        return _describe(out, complete)
    from softfin.evaluation.report import write_report

    stages = _list_stages(out, plant, PRESETS[preset], seed)
    rows = []
    for number, stage in enumerate(stages, start=1):
        rows.append(_run(stage, f"{number}/{len(stages)} {stage.name}", progress))
    results = _collect_results(out, plant, preset, seed, rows)
    write_report(out / "report.html", results, _find_figures(out, results))
    # Written last, because it marks the run as complete.
    artifacts.write_file(out / RESULTS, artifacts.dump_json(results))
    shutil.rmtree(_replaced(out), ignore_errors=True)
    return _describe(out, results)


def _claim(
    out: Path, plant: str, preset: ReproducePreset, seed: int, resume: bool, overwrite: bool
) -> None:
    """Claim the folder for this run, or resume a stopped run with the same options."""
    from softfin.core.plant_identity import identity
    from softfin.storage.registry import find_plant
    from softfin.storage.run_directory import check_same, software_versions

    metadata = {
        "plant": identity(find_plant(plant)),
        "seed": seed,
        "preset": preset,
        "configuration": artifacts.plain(PRESETS[preset]._asdict()),
        "software": software_versions(),
    }
    if resume and artifacts.is_kind(out, REPRODUCTION_KIND):
        try:
            before = artifacts.load_description(out, REPRODUCTION_KIND)
            check_same(out, {name: before.get(name) for name in metadata}, metadata)
        except ArtifactError:
            if not overwrite:
                raise
        else:
            return
    artifacts.check_vacant(out, overwrite, kind=REPRODUCTION_KIND)
    if artifacts.is_kind(out, REPRODUCTION_KIND):
        _clear(out, plant)
    # A link may now refer to a folder that no longer exists.
    artifacts.write_file(
        out.resolve() / f"{REPRODUCTION_KIND}.json",
        artifacts.encode_description(REPRODUCTION_KIND, metadata),
    )


def _clear(out: Path, plant: str) -> None:
    """Set a complete run aside until the new run is complete, or remove an unfinished run."""
    folder = out.resolve()
    if Path(plant).exists() and Path(plant).resolve().is_relative_to(folder):
        raise ArtifactError(
            f"{out}: contains the plant {plant}, which would also be replaced; choose a different "
            "--out"
        )
    try:
        if (folder / RESULTS).is_file():
            shutil.rmtree(_replaced(out), ignore_errors=True)
            folder.rename(_replaced(out))
        else:
            shutil.rmtree(folder)
    except OSError as error:
        raise RunError(
            f"{out}: cannot be replaced ({error.strerror or error}); remove it, or choose a "
            "different --out"
        ) from None


def _replaced(out: Path) -> Path:
    """Return the folder that keeps the previous run while a new run replaces it."""
    folder = out.resolve()
    return folder.with_name(f".{folder.name}.before")


def _list_stages(out: Path, plant: str, preset: Preset, seed: int) -> list[Stage]:
    """Return the stages of a run, in order."""
    surrogate = plant if is_surrogate(plant) else str(out / "surrogate")
    seeds = range(seed, seed + preset.num_seeds)
    stages: list[Stage] = []
    if not is_surrogate(plant):
        stages += _learn_surrogate(out, plant, preset, seed)
    stages.append(
        Stage(
            "map",
            "the controller gaits: the mean forces that the fin can produce in the surrogate, and "
            "the gaits (six actions each) that produce them",
            out / "gaits",
            partial(map_forces, surrogate, out=out / "gaits", config=preset.gaits),
        )
    )
    for kind, changes in preset.policies.items():
        policies = "one recurrent policy" if kind == "single" else "a recurrent policy per cell"
        for each, folder in zip(seeds, _folders(out, kind, seeds), strict=True):
            work = partial(train, surrogate, controller=kind, seed=each, config=changes)
            stages.append(
                Stage(
                    f"train {folder.name}",
                    f"the controller {kind}: {policies}, trained in the surrogate by LSTM-PPO, "
                    f"seed {each}",
                    folder,
                    partial(work, out=folder, resume=True),
                )
            )
    controllers = {kind: _folders(out, kind, seeds) for kind in ("gaits", *preset.policies)}
    stages += _list_evaluations(out, plant, surrogate, preset, seed, controllers)
    first = [folders[0] for folders in controllers.values()]
    stages.append(
        Stage(
            "explore",
            "a page to drag the target force and watch these controllers follow it",
            out / PAGE,
            partial(_write_page, first, out / PAGE, (surrogate, plant)),
        )
    )
    return stages


def _folders(out: Path, kind: str, seeds: range) -> list[Path]:
    """Return the folder of the controller trained from each seed; there is only one for gaits."""
    if kind == "gaits" or len(seeds) == 1:
        return [out / kind]
    return [out / f"{kind}-{seed}" for seed in seeds]


def _learn_surrogate(out: Path, plant: str, preset: Preset, seed: int) -> Iterator[Stage]:
    dataset = out / "dataset"
    yield Stage(
        "collect",
        "random strokes of the fin and the resulting force",
        dataset,
        partial(collect, plant=plant, out=dataset, seed=seed, config=preset.collect),
    )
    # Errors are ignored because the logs were recorded by this run, not by a user's program.
    recordings = ImportConfig(ignore_errors=("all",))
    work = partial(fit, dataset, model=preset.model, config=preset.fit, recordings=recordings)
    yield Stage(
        "fit",
        "a surrogate: neural networks that predict the fin's motion and force from its commands",
        out / "surrogate",
        partial(work, out=out / "surrogate", seed=seed, resume=True),
    )


def _list_evaluations(
    out: Path,
    plant: str,
    surrogate: str,
    preset: Preset,
    seed: int,
    controllers: Mapping[str, list[Path]],
) -> Iterator[Stage]:
    """Yield the evaluation stages of all controllers: in the plant, with force feedback, and in the
    surrogate."""
    from softfin.gaits.reachable import PAPER_REFERENCES

    asked = {"references": PAPER_REFERENCES, "seed": seed, **preset.evaluate}
    moving = asked | ({"recorded": ONE_STEP} if preset.moving else {})
    parts = [("evaluation", plant, moving, False)]
    if preset.moving:
        parts.append(("evaluation-with-feedback", plant, moving, True))
    if surrogate != plant:
        parts.append(("evaluation-in-surrogate", surrogate, asked, False))
    for folder, place, config, feedback in parts:
        where = {surrogate: "the surrogate", TANK: "the virtual tank"}.get(place, place)
        ending = ", with feedback (--feedback)" if feedback else ""
        for kind, paths in controllers.items():
            result = out / folder / kind
            # Policies differ in their training seeds, whereas evaluations of gaits differ in the
            # plant noise.
            repeats = preset.num_seeds if kind == "gaits" else 1
            work = partial(evaluate, *paths, plant=place, config=config, repeats=repeats)
            yield Stage(
                f"{folder} {kind}",
                f"evaluation of the controller {kind} in {where}{ending}",
                result,
                partial(work, out=result, feedback=feedback),
            )


def _write_page(
    controllers: list[Path], out: Path, plants: tuple[str, str], progress: Progress
) -> None:
    """Write the explorer page for trying controllers if it can simulate one of the plants."""
    from softfin.explorer.contents import is_shown
    from softfin.storage.registry import find_plant

    # The plant of this run may itself be the surrogate folder, possibly under a different path.
    places = {Path(name).resolve(): name for name in plants}
    shown = [name for name in reversed(places.values()) if is_shown(find_plant(name))]
    if shown:
        explore(*controllers, out=out, plant=tuple(shown))


def _run(stage: Stage, title: str, progress: Progress) -> "StageRow":
    """Run a stage unless its result exists; return its description and times."""
    wall_s = processor_s = None
    if not stage.result.exists():
        progress(title, 0.0, "")
        start_s = time.perf_counter()
        start_processor_s = time.process_time()
        stage.work(progress=lambda _, done, note: progress(title, done, note))
        wall_s = time.perf_counter() - start_s
        processor_s = time.process_time() - start_processor_s
    row: StageRow = {
        "stage": stage.name,
        "what": stage.what,
        "wall_s": wall_s,
        "processor_s": processor_s,
    }
    if stage.result.name == PAGE and stage.result.exists():
        row["page"] = PAGE
    return row


def _collect_results(
    out: Path, plant: str, preset: ReproducePreset, seed: int, stages: "list[StageRow]"
) -> "RunResults":
    """Return the contents of ``results.json``, collected from the files of the stages."""

    def read_evaluations(folder: str) -> "dict[str, EvaluationSummary]":
        summaries: dict[str, Any] = {}
        for kind in ("gaits", *policies):
            file = out / folder / kind / "evaluation.json"
            remedy = f"remove {file.parent}, then use --resume"
            if file.exists():
                summaries[kind] = artifacts.read_json(file, remedy)
        return summaries

    policies = PRESETS[preset].policies
    surrogate = None
    if (out / "surrogate").exists():
        surrogate = {"scores": artifacts.load_description(out / "surrogate", "surrogate")["scores"]}
    return {
        **artifacts.head(REPRODUCTION_KIND),  # type: ignore[typeddict-item]
        "title": "softfin: force control of a soft fin",
        "preset": preset,
        "plant": plant,
        "seed": seed,
        "seeds": PRESETS[preset].num_seeds,
        "surrogate": surrogate,
        "controllers": read_evaluations("evaluation"),
        "with_feedback": read_evaluations("evaluation-with-feedback") or None,
        "in_surrogate": read_evaluations("evaluation-in-surrogate") or None,
        "stages": stages,
        "wall_s": {row["stage"]: row["wall_s"] for row in stages if row["wall_s"] is not None},
        "peak_memory_gib": _peak_memory_gib(),
        "provenance": artifacts.provenance(seed=seed, plant=plant),
    }


def _find_figures(out: Path, results: "RunResults") -> dict[str, dict[str, Path]]:
    """Return the figures of the stages, keyed by report section and caption."""
    from softfin.evaluation.headline import headline

    prediction = {"Force in a test log and in the surrogate": out / "surrogate/prediction.png"}
    learning = {}
    experiment = {}
    moving = {}
    shown = out / ("evaluation-with-feedback" if results["with_feedback"] else "evaluation")
    seeds = range(results["seed"], results["seed"] + results["seeds"])
    for kind in results["controllers"]:
        caption = f"{kind} controller, seed {results['seed']}"
        learning[caption] = _folders(out, kind, seeds)[0] / "training/learning.png"
        experiment[caption] = out / "evaluation" / kind / "experiments.png"
        for file in sorted((shown / kind).glob("*.png")):
            if file.stem not in ("experiments", "fin"):
                moving[f"{caption}, {file.stem}"] = file
    fin = {}
    if best := headline(results):
        fin["Fin with the best controller; grey: its stroke"] = shown / best.controller / "fin.png"
    sections = {
        "fin": fin,
        "surrogate": prediction,
        "learning": learning,
        "experiment": experiment,
        "moving": moving,
    }
    return {
        section: {caption: file for caption, file in figures.items() if file.exists()}
        for section, figures in sections.items()
    }


def _describe(out: Path, results: "RunResults") -> Result:
    """Return the results with the text printed by the command."""
    from softfin.evaluation.headline import error_decimals, headline
    from softfin.stages.tables import (
        format_paper_tables,
        format_table_one,
        moving_table,
        table_two,
    )

    parts = []
    if results["surrogate"] is not None:
        parts.append(format_table_one(results["surrogate"]["scores"]))
    plant = results["plant"]
    evaluated = {
        f"On {plant}": results["controllers"],
        "The same, with force feedback (--feedback)": results["with_feedback"],
        "The same, in the surrogate used for training": results["in_surrogate"],
    }
    for title, summaries in evaluated.items():
        if summaries:
            parts.append(f"{title}\n{table_two(summaries)}")
            for name, summary in summaries.items():
                if rows := summary.get("moving"):
                    parts[-1] += f"\n{name}, {moving_table(rows, error_decimals(summary))}"
    if results["preset"] == "paper":
        parts.append(format_paper_tables())
    processor_s = sum(stage["processor_s"] or 0.0 for stage in results["stages"])
    parts.append(
        f"{sum(results['wall_s'].values()):.0f} s, {processor_s:.0f} s of CPU time; peak memory "
        f"{results['peak_memory_gib']:.1f} GiB"
    )
    best = headline(results)
    parts.append(f"{'' if best is None else best.sentence}\nsee {out / 'report.html'}")
    if any("page" in stage for stage in results["stages"]):
        parts.append(f"{out / PAGE}: drag the target force and watch the fin follow it")
    return Result(results, "\n\n".join(parts))


def _peak_memory_gib() -> float:
    """Return the peak resident memory of this process so far [GiB]."""
    # macOS reports bytes, Linux kibibytes.
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (2**30 if sys.platform == "darwin" else 2**20)
