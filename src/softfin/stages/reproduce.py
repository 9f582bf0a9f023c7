"""The main job in one run: collect, fit, train, evaluate, report; each stage a folder, so a stopped run can go on."""

import resource
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from pydantic import PositiveInt, model_validator

from softfin.core.choices import ReproducePreset
from softfin.core.configuration import Configuration
from softfin.core.plant import EnsemblePlant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, write_evaluation
from softfin.evaluation.figures import experiments_figure
from softfin.evaluation.report import prediction_figure, write_report
from softfin.evaluation.scores import Scores, SurrogateUncertainty
from softfin.learning.configuration import GRADIENT_GRID, GRADIENT_SINGLE, GRID, SINGLE, TrainConfig
from softfin.learning.controllers import learning_figure
from softfin.stages.collect import collect
from softfin.stages.controllers import train
from softfin.stages.evaluation import evaluation_of
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant, is_surrogate
from softfin.storage.run_directory import LOG, TRAINING_LOG, check_same, read_log
from softfin.surrogate import FitConfig, StreamingConfig, load_surrogate
from softfin.surrogate.compare.scores import free_run

CONTROLLERS = ("single", "grid")


class ReproduceConfig(Configuration):
    """All stages; the defaults are the paper's data and budgets."""

    collect: CollectConfig = CollectConfig()
    """Logs of the plant; not used when the plant is a surrogate."""
    fit: FitConfig | StreamingConfig = FitConfig()
    """The surrogate, the paper's nets or streaming ones; not used when the plant is one."""
    single: TrainConfig = SINGLE
    """One controller for all references."""
    grid: TrainConfig = GRID
    """One policy a cell."""
    evaluate: EvaluateConfig = EvaluateConfig(seeds=1)
    """The experiments; each trained controller does all of them, `seeds` times."""
    seeds: PositiveInt = 5
    """Controllers trained of each kind, from seeds 0, 1, ...: the intervals are over these."""

    @model_validator(mode="after")
    def _covered(self) -> "ReproduceConfig":
        for name in ("moving", "recorded", "error_map", "random"):
            if getattr(self.evaluate, name):
                raise ValueError(f"evaluate.{name} is set; a reproduction evaluates constant references: leave it out; "
                                 "give it to softfin evaluate with a controller of the reproduction")  # fmt: skip
        for reference in self.evaluate.references:
            for kind in CONTROLLERS:
                if all(cell.distance(reference) > 0 for cell in getattr(self, kind).cells):
                    missing = f"evaluate.references has {reference} N, which no cell of {kind} covers"
                    raise ValueError(f"{missing}; add a cell")
        return self


PRESETS: dict[ReproducePreset, ReproduceConfig] = {
    "paper": ReproduceConfig(),
    "streaming": ReproduceConfig(fit=StreamingConfig()),
    "best": ReproduceConfig(fit=StreamingConfig(), single=GRADIENT_SINGLE, grid=GRADIENT_GRID),
    "demo": ReproduceConfig(
        collect=CollectConfig(logs=20, rows=12_000),
        fit=FitConfig(epochs=4),
        single=SINGLE.model_copy(update={"steps": 20_000}),
        grid=GRID.model_copy(update={"steps": 8_000}),
        seeds=2,
    ),
    "tiny": ReproduceConfig(
        collect=CollectConfig(logs=3, test_logs=1, rows=1500),
        fit=FitConfig(epochs=1),
        single=SINGLE.model_copy(update={"steps": 960}),
        grid=GRID.model_copy(update={"steps": 960}),
        evaluate=EvaluateConfig(seeds=1, seconds=6),
        seeds=2,
    ),
}
"""``paper``: the paper's full data and budgets. ``streaming``: the same with a streaming surrogate.
``best``: that surrogate, and controllers by gradients through it.
``demo``: a few minutes, with two thirds of the paper's steps or more.
``tiny``: does every stage work at all?"""

KIND = "reproduction"
RESULTS = "results.json"
SHOWN_S = 8
"""Length of the stretch of a test log in the report [s]."""


def reproduce(
    plant: str, out: Path, config: ReproduceConfig | None = None, *,
    seed: int = 0, resume: bool = False, overwrite: bool = False, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Run all stages into `out` and write ``results.json``, whose keys docs/files.md lists, and ``report.html``."""
    config = config or ReproduceConfig()
    run = _Reproduction(plant, out, config, seed, progress)
    run.claim(resume, overwrite)
    scores = None if is_surrogate(plant) else run.learn_surrogate()
    for kind in CONTROLLERS:
        run.train(kind)
    evaluated = run.evaluate(plant, "evaluation")
    within = None if is_surrogate(plant) else run.evaluate(str(run.surrogate), "evaluation-in-surrogate")
    results = {
        "title": "softfin: force control of a soft fin",
        "preset": next((name for name, preset in PRESETS.items() if preset == config), "custom"),
        "plant": plant,
        "seed": seed,
        "seeds": config.seeds,
        "surrogate": None if scores is None else {"scores": scores},
        "controllers": {kind: summary for kind, (summary, _) in evaluated.items()},
        "in_surrogate": None if within is None else {kind: summary for kind, (summary, _) in within.items()},
        "wall_s": run.wall_s,
        "peak_memory_gib": _peak_memory_gib(),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=seed, plant=plant),
    }
    figures = {
        "surrogate": run.surrogate_figures() if scores is not None else {},
        "learning": run.learning_figures(),
        "experiment": {
            f"{kind} controller, seed {seed}": experiments_figure(e.recording) for kind, (_, e) in evaluated.items()
        },
    }
    write_report(out / "report.html", results, figures)
    # Last: it says that the run is complete.
    artifacts.write_file(out / RESULTS, artifacts.dump_json(results))
    shutil.rmtree(run.replaced, ignore_errors=True)
    return results


class _Reproduction:
    """One run and where its parts lie."""

    def __init__(self, plant: str, out: Path, config: ReproduceConfig, seed: int, progress: Progress) -> None:
        self.plant, self.out, self.config, self.seed, self.progress = plant, out, config, seed, progress
        self.dataset, self.wall_s = out / "dataset", dict[str, float]()
        self.surrogate = Path(plant) if is_surrogate(plant) else out / "surrogate"
        self.seeds = tuple(range(seed, seed + config.seeds))
        self.replaced = out.absolute().with_name(f".{out.absolute().name}.replaced")

    def claim(self, resume: bool, overwrite: bool) -> None:
        """Take the folder for this run, or take it over from a stopped run with the same options.

        A complete run that is to be replaced is kept beside it until this one is complete.
        """
        configuration = self.config.model_dump(mode="json")
        plant = identity(find_plant(self.plant), computed=True)
        metadata = {"plant": plant, "seed": self.seed, "configuration": configuration}
        if resume and artifacts.is_kind(self.out, KIND):
            before = {name: artifacts.load_description(self.out, KIND).get(name) for name in metadata}
            check_same(self.out, before, metadata)
            return
        artifacts.check_vacant(self.out, overwrite)
        if (self.out / RESULTS).is_file():
            shutil.rmtree(self.replaced, ignore_errors=True)
            self.out.rename(self.replaced)
        shutil.rmtree(self.out, ignore_errors=True)
        artifacts.write_file(self.out / f"{KIND}.json", artifacts.dump_json(metadata))
        artifacts.write_file(self.out / "configuration.yaml", yaml.safe_dump(configuration, sort_keys=False))

    def stage(self, name: str, result: Path, work: Callable[..., Any], source: Any, config: Any, **given: Any) -> None:
        """Do the work unless its result stands there from before."""
        if not result.exists():
            start = time.perf_counter()
            work(source, result, config, **given, progress=self.progress)
            self.wall_s[name] = time.perf_counter() - start

    def learn_surrogate(self) -> dict[str, Any] | None:
        """Collect and fit; Table I."""
        settings = self.config.collect.merged({"seed": self.seed}, "seed")
        self.stage("collect", self.dataset, collect, self.plant, settings)
        given = self.dataset, self.config.fit
        self.stage("fit", self.surrogate, fit, *given, seed=self.seed, resume=True, ignore_errors=True)
        scores: dict[str, Any] | None = artifacts.load_description(self.surrogate, "surrogate")["scores"]
        return scores

    def train(self, kind: str) -> None:
        """All seeds of one kind of controller, in one program."""
        config, surrogate = getattr(self.config, kind), str(self.surrogate)
        self.stage(f"train {kind}", self.out / kind, train, surrogate, config, seeds=self.seeds, resume=True)

    def evaluate(self, plant: str, folder: str) -> dict[str, tuple[dict[str, Any], Evaluation]]:
        """Every seed's controller of each kind on a plant, as one evaluation over the seeds."""
        start, evaluated, moving = time.perf_counter(), {}, find_plant(plant)
        for kind in CONTROLLERS:
            each = []
            for index, seed in enumerate(self.seeds):
                self.progress(f"evaluate {kind}", (index + 1) / len(self.seeds), plant)
                path = self.out / kind / f"seed-{seed}" if len(self.seeds) > 1 else self.out / kind
                config = self.config.evaluate.model_copy(update={"seed": seed})
                each.append(evaluation_of(path, moving, config, plant))
            whole = _together(each)
            metadata = {"controller": kind, "plant": plant, "repetitions": "controllers trained from different seeds"}
            evaluated[kind] = write_evaluation(whole, self.out / folder / kind, metadata, overwrite=True), whole
        self.wall_s[folder] = time.perf_counter() - start
        return evaluated

    def learning_figures(self) -> dict[str, Figure]:
        """Reward over the steps, and the error of the policies without their noise."""
        logs = {kind: read_log(self.out / kind / TRAINING_LOG / LOG) for kind in CONTROLLERS}

        def curve(log: list[dict[str, Any]], keys: list[str]) -> tuple[list[int], list[float]]:
            entries = [entry for entry in log if keys[0] in entry]
            return [e["step"] for e in entries], [float(np.mean([e[key] for key in keys])) for e in entries]

        def curves(*names: str) -> dict[str, Any]:
            keys = [[f"seed{seed}/{name}" for name in names] for seed in self.seeds]
            return {kind: [curve(log, each) for each in keys] for kind, log in logs.items()}

        return {
            "Mean reward a step while exploring": learning_figure(curves("reward"), "mean reward a step [N]"),
            "Mean error of the policies without exploration noise, over both axes": learning_figure(
                curves("score_x_n", "score_y_n"), "error without noise [N]"
            ),
        }

    def surrogate_figures(self) -> dict[str, Figure]:
        """A stretch of an unseen log beside what the surrogate says."""
        data, surrogate = Dataset.open(self.dataset), load_surrogate(self.surrogate)
        if not data.test:
            return {}
        log = next(data.load(data.test[:1]))
        rows = len(log.reading.time)
        first = max(surrogate.memory, min(10 * RATE_HZ, rows // 2))
        ticks = min(SHOWN_S * RATE_HZ, rows - first)
        stretch = slice(first, first + ticks)
        free, _ = free_run(surrogate, [log], [(0, first)], ticks)
        predicted = {"free-running": np.asarray(free.force[0])}
        if not isinstance(surrogate, EnsemblePlant):
            behind = slice(first - surrogate.window, stretch.stop - surrogate.window)
            predicted = {"given the angle": surrogate.predict_force(log, free_running=False)[behind], **predicted}
        return {"Force in a test log and in the surrogate": prediction_figure(
            np.asarray(log.reading.force[stretch]), predicted, first / RATE_HZ
        )}  # fmt: skip


def _together(each: list[Evaluation]) -> Evaluation:
    """One evaluation whose repetitions are the controllers, each the mean of its own; the recording is the first's."""
    means = [[field.mean(axis=1) for field in e.scores] for e in each]
    scores = Scores(*(np.stack(fields, axis=1) for fields in zip(*means, strict=True)))
    estimates = [e.uncertainty for e in each if e.uncertainty is not None]
    uncertainty = SurrogateUncertainty(
        np.mean([estimate.out_of_distribution_fraction for estimate in estimates], axis=0),
        np.max([estimate.furthest for estimate in estimates], axis=0),
        np.mean([estimate.half_width for estimate in estimates], axis=0),
    ) if estimates else None  # fmt: skip
    warnings = tuple(dict.fromkeys(warning for e in each for warning in e.warnings))
    return Evaluation(each[0].config, scores, len(each), each[0].recording, uncertainty, warnings)


def _peak_memory_gib() -> float:
    """Largest resident memory of this process so far."""
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (2**30 if sys.platform == "darwin" else 2**20)
