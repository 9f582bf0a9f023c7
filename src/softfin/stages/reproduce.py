"""The main job in one run: collect, fit, train, evaluate, report; each stage a folder, so a stopped run can go on."""

import resource
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

from softfin.core.errors import ArtifactError
from softfin.core.plant import EnsemblePlant
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ
from softfin.evaluation.evaluate import Evaluation, write_evaluation
from softfin.evaluation.figures import experiments_figure
from softfin.evaluation.report import prediction_figure, write_report
from softfin.evaluation.scores import Scores, SurrogateUncertainty
from softfin.learning.figure import learning_figure
from softfin.stages.collect import collect
from softfin.stages.evaluate import evaluation_of
from softfin.stages.fit import fit
from softfin.stages.presets import CONTROLLERS, PRESETS, ReproduceConfig
from softfin.stages.train import train as train_stage
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant, is_surrogate
from softfin.storage.run_directory import LOG, TRAINING_LOG, read_log
from softfin.surrogate import load_surrogate
from softfin.surrogate.compare.free_running import Segment, free_run

KIND = "reproduction"
RESULTS = "results.json"
SHOWN_S = 8
"""Length of the stretch of a test log in the report [s]."""


def reproduce(
    plant: str,
    out: Path,
    config: ReproduceConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run all stages into `out` and write ``results.json`` and ``report.html``; returns the results.

    ``results.json``:

    ================= ================================================================================================
    ``plant``         plant of the evaluations; ``preset``, ``seed`` and ``seeds`` say how
    ``surrogate``     null when the plant is a surrogate, else ``scores``: Table I (see `surrogate.metrics.table_one`)
    ``controllers``   ``single`` and ``grid``, each what `evaluation.evaluate.write_evaluation` writes: per reference
                      and axis ``error_n``, ``std_n``, ``raw_std_n`` and their 95% intervals over the trained seeds
    ``in_surrogate``  the same controllers in the surrogate that they were trained in; null when that is `plant`
    ``wall_s``        wall-clock time of each stage, as far as it ran in this call
    ``peak_memory_gib`` of this process
    ``configuration``, ``provenance``
    ================= ================================================================================================
    """
    config = config or ReproduceConfig()
    run = _Reproduction(plant, out, config, seed, progress)
    run.claim(resume, overwrite)
    scores = None if is_surrogate(plant) else run.learn_surrogate()
    for kind in CONTROLLERS:
        run.stage(f"train {kind}", out / kind, partial(run.train, kind))
    evaluated = run.evaluate(plant, "evaluation")
    within = None if is_surrogate(plant) else run.evaluate(str(run.surrogate), "evaluation-in-surrogate")
    results = {
        "title": "softfin: force control of a soft fin",
        "preset": run.preset,
        "plant": plant,
        "seed": seed,
        "seeds": config.seeds,
        "surrogate": None if scores is None else {"scores": scores},
        "controllers": {kind: summary for kind, (summary, _) in evaluated.items()},
        "in_surrogate": None if within is None else {kind: summary for kind, (summary, _) in within.items()},
        "wall_s": run.wall_s,
        "peak_memory_gib": peak_memory_gib(),
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

    def __init__(self, plant: str, out: Path, config: ReproduceConfig, seed: int, progress: Progress | None) -> None:
        self.plant, self.out, self.config, self.seed, self.progress = plant, out, config, seed, progress
        self.preset = next((name for name, preset in PRESETS.items() if preset == config), "custom")
        self.settings = config.collect.merged({"seed": seed}, "seed")
        self.dataset, self.wall_s = out / "dataset", dict[str, float]()
        self.surrogate = Path(plant) if is_surrogate(plant) else out / "surrogate"
        self.seeds = tuple(range(seed, seed + config.seeds))
        self.replaced = out.absolute().with_name(f".{out.absolute().name}.replaced")

    def claim(self, resume: bool, overwrite: bool) -> None:
        """Take the folder for this run, or take it over from a stopped run with the same options.

        A complete run that is to be replaced is kept beside it until this one is complete.
        """
        metadata = {
            "plant": identity(find_plant(self.plant)), "seed": self.seed,
            "configuration": self.config.model_dump(mode="json"),
        }  # fmt: skip
        if resume and artifacts.is_kind(self.out, KIND):
            before = artifacts.load_description(self.out, KIND)
            changed = [name for name, value in metadata.items() if before.get(name) != value]
            if changed:
                raise ArtifactError(f"{self.out}: holds a run with another {' and '.join(changed)}; resume with the "
                                    "same options, or give another --out")  # fmt: skip
            return
        artifacts.check_vacant(self.out, overwrite)
        if (self.out / RESULTS).is_file():
            shutil.rmtree(self.replaced, ignore_errors=True)
            self.out.rename(self.replaced)
        shutil.rmtree(self.out, ignore_errors=True)
        artifacts.write_file(self.out / f"{KIND}.json", artifacts.dump_json(metadata))
        artifacts.write_file(
            self.out / "configuration.yaml", yaml.safe_dump(metadata["configuration"], sort_keys=False)
        )

    def stage(self, name: str, result: Path, work: Callable[[], Any]) -> None:
        """Do the work unless its result stands there from before."""
        if result.exists():
            return
        start = time.perf_counter()
        work()
        self.wall_s[name] = time.perf_counter() - start

    def learn_surrogate(self) -> dict[str, Any] | None:
        """Collect and fit; Table I."""
        self.stage(
            "collect", self.dataset,
            lambda: collect(self.plant, self.dataset, self.settings, progress=self.progress),
        )  # fmt: skip
        self.stage(
            "fit", self.surrogate,
            lambda: fit(self.dataset, self.surrogate, self.config.fit, seed=self.seed, resume=True,
                               ignore_errors=True, progress=self.progress),
        )  # fmt: skip
        scores: dict[str, Any] | None = artifacts.load_description(self.surrogate, "surrogate")["scores"]
        return scores

    def train(self, kind: str) -> None:
        """All seeds of one kind of controller, in one program."""
        config = getattr(self.config, kind)
        train_stage(str(self.surrogate), self.out / kind, config, seeds=self.seeds, resume=True, progress=self.progress)

    def evaluate(self, plant: str, folder: str) -> dict[str, tuple[dict[str, Any], Evaluation]]:
        """Every seed's controller of each kind on a plant, as one evaluation over the seeds."""
        start, evaluated = time.perf_counter(), {}
        for kind in CONTROLLERS:
            each = []
            for index, seed in enumerate(self.seeds):
                if self.progress is not None:
                    self.progress(f"evaluate {kind}", (index + 1) / len(self.seeds), plant)
                path = self.out / kind / f"seed-{seed}" if len(self.seeds) > 1 else self.out / kind
                each.append(evaluation_of(path, plant, self.config.evaluate.model_copy(update={"seed": seed})))
            whole = _together(each)
            metadata = {"controller": kind, "plant": plant, "repetitions": "controllers trained from different seeds"}
            evaluated[kind] = write_evaluation(whole, self.out / folder / kind, metadata, overwrite=True), whole
        self.wall_s[folder] = time.perf_counter() - start
        return evaluated

    def learning_figures(self) -> dict[str, Figure]:
        """Reward over the steps, and the error of the policies without their noise."""
        logs = {kind: read_log(self.out / kind / TRAINING_LOG / LOG) for kind in CONTROLLERS}

        def curves(*names: str) -> dict[str, Any]:
            return {kind: [_curve(log, seed, names) for seed in self.seeds] for kind, log in logs.items()}

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
        free = free_run(surrogate, [log], [Segment(0, first)], ticks)
        predicted = {"free-running": np.asarray(free.reading.force[0])}
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


def _curve(log: list[dict[str, Any]], seed: int, names: tuple[str, ...]) -> tuple[list[int], list[float]]:
    keys = [f"seed{seed}/{name}" for name in names]
    entries = [entry for entry in log if keys[0] in entry]
    return [e["step"] for e in entries], [float(np.mean([e[key] for key in keys])) for e in entries]


def peak_memory_gib() -> float:
    """Largest resident memory of this process so far."""
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (2**30 if sys.platform == "darwin" else 2**20)


__all__ = ["PRESETS", "ReproduceConfig", "peak_memory_gib", "reproduce"]
