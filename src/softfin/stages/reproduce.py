"""The complete pipeline in one run: collect, fit, train, evaluate, report. Each stage has its own
folder, so that a stopped run can continue."""

import json
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import jax
import numpy as np
import yaml
from matplotlib.figure import Figure

from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError
from softfin.core.json_object import JsonObject
from softfin.core.plant import roll
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ
from softfin.evaluation.evaluate import Evaluation, score_controller, together, write_evaluation
from softfin.evaluation.figures import experiments_figure, moving_figure
from softfin.evaluation.report import prediction_figure, write_report
from softfin.evaluation.results import EvaluationSummary, RunResults, StageRow
from softfin.learning.controllers import Curve, learning_curve, learning_figure
from softfin.stages.collect import collect
from softfin.stages.controllers import map_forces, train
from softfin.stages.evaluation import check_limits
from softfin.stages.explore import explore, is_shown
from softfin.stages.reproduce_config import PRESETS, ReproduceConfig
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import find_plant, is_surrogate
from softfin.storage.run_directory import LOG, TRAINING_LOG, check_same, read_training_log
from softfin.surrogate import Surrogate, load_surrogate

REPRODUCTION_KIND = "reproduction"
RESULTS = "results.json"
PAGE = "explore.html"
SHOWN_TEST_S = 8
"""Length of the test-log segment in the report [s]."""

Evaluated: TypeAlias = dict[str, tuple[EvaluationSummary, Evaluation]]
"""Contents of ``evaluation.json`` and the evaluation, by kind of controller."""


@lock_output
def reproduce(
    plant: str,
    out: Path,
    config: ReproduceConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> RunResults:
    """Run all stages into `out`; writes ``results.json`` (keys: docs/files.md) and ``report.html``.

    If a page can simulate the plant or the surrogate, also writes ``explore.html``, for trying the
    controllers.
    """
    config = config or ReproduceConfig()
    run = _Reproduction(plant, out, config, seed, progress)
    run.claim(resume, overwrite)
    if resume and (out / RESULTS).is_file():
        # The run is complete; evaluating again would only erase the times of its stages.
        complete: RunResults = json.loads((out / RESULTS).read_text())
        return complete
    scores = None if is_surrogate(plant) else run.learn_surrogate()
    run.make_controllers()
    evaluated = run.evaluate(plant, "evaluation")
    observed = (
        None
        if config.evaluate.trim is None
        else run.evaluate(plant, "evaluation-trimmed", trim=True)
    )
    within = (
        None
        if is_surrogate(plant)
        else run.evaluate(str(run.surrogate), "evaluation-in-surrogate", moving=False)
    )
    run.make_page()

    results: RunResults = {
        **artifacts.head(REPRODUCTION_KIND),
        "title": "softfin: force control of a soft fin",
        "preset": next((name for name, preset in PRESETS.items() if preset == config), "custom"),
        "plant": plant,
        "seed": seed,
        "seeds": config.seeds,
        "surrogate": None if scores is None else {"scores": scores},
        "controllers": summaries(evaluated),
        "trimmed": None if observed is None else summaries(observed),
        "in_surrogate": None if within is None else summaries(within),
        "stages": run.stages,
        "wall_s": {
            stage["stage"]: stage["wall_s"] for stage in run.stages if stage["wall_s"] is not None
        },
        "peak_memory_gib": _peak_memory_gib(),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=seed, plant=plant),
    }
    figures = run.figures(results, evaluated, observed or evaluated)
    write_report(out / "report.html", results, figures)
    # Written last, because it marks the run as complete.
    artifacts.write_file(out / RESULTS, artifacts.dump_json(results))
    shutil.rmtree(run.replaced, ignore_errors=True)
    return results


def summaries(evaluated: Evaluated) -> dict[str, EvaluationSummary]:
    """Return the contents of ``evaluation.json`` of each kind of controller."""
    return {kind: summary for kind, (summary, _) in evaluated.items()}


class _Reproduction:
    """A run and the folders for its parts."""

    def __init__(
        self, plant: str, out: Path, config: ReproduceConfig, seed: int, progress: Progress
    ) -> None:
        self.plant = plant
        self.out = out
        self.config = config
        self.seed = seed
        self.progress = progress
        self.dataset = out / "dataset"
        self.stages: list[StageRow] = []
        self.surrogate = Path(plant) if is_surrogate(plant) else out / "surrogate"
        self.seeds = tuple(range(seed, seed + config.seeds))
        self.replaced = out.absolute().with_name(f".{out.absolute().name}.replaced")

    def claim(self, resume: bool, overwrite: bool) -> None:
        """Claim the folder for this run, or continue a stopped run with the same options.

        A complete run that is being replaced is kept until this one is complete.
        """
        configuration = self.config.model_dump(mode="json")
        plant = identity(find_plant(self.plant))
        metadata = {"plant": plant, "seed": self.seed, "configuration": configuration}
        if resume and artifacts.is_kind(self.out, REPRODUCTION_KIND):
            try:
                before = artifacts.load_description(self.out, REPRODUCTION_KIND)
                check_same(self.out, {name: before.get(name) for name in metadata}, metadata)
            except ArtifactError:
                if not overwrite:
                    raise
            else:
                return
        artifacts.check_vacant(self.out, overwrite)
        # Only a complete run is kept until the new one is complete.
        if (self.out / RESULTS).is_file():
            shutil.rmtree(self.replaced, ignore_errors=True)
            self.out.rename(self.replaced)
        shutil.rmtree(self.out, ignore_errors=True)
        artifacts.write_file(
            self.out / f"{REPRODUCTION_KIND}.json",
            artifacts.encode_description(REPRODUCTION_KIND, metadata),
        )
        artifacts.write_file(
            self.out / "configuration.yaml", yaml.safe_dump(configuration, sort_keys=False)
        )

    def stage(
        self,
        name: str,
        what: str,
        result: Path,
        work: Callable[..., object],
        *given: object,
        **options: object,
    ) -> None:
        """Do the work unless its result already exists; `what` describes the result."""
        if not result.exists():
            with self.timed(name, what):
                work(*given, **options, progress=self.begin(name))
        else:
            self.stages.append({"stage": name, "what": what, "wall_s": None, "processor_s": None})

    @contextmanager
    def timed(self, name: str, what: str) -> Iterator[None]:
        """Record a stage's result, wall-clock time and CPU time when it ends."""
        start_s = time.perf_counter()
        start_processor_s = time.process_time()
        yield
        wall_s = time.perf_counter() - start_s
        processor_s = time.process_time() - start_processor_s
        self.stages.append(
            {"stage": name, "what": what, "wall_s": wall_s, "processor_s": processor_s}
        )

    def begin(self, name: str) -> Progress:
        """Start a stage; returns its progress callback, which adds the stage's number."""
        number = len(self.stages) + 1
        count = self.count
        self.progress(f"{number}/{count} {name}", 0.0, "")
        return lambda stage, done, note: self.progress(f"{number}/{count} {stage}", done, note)

    @property
    def count(self) -> int:
        """Number of stages."""
        # The evaluation, the map, and a training for each kind and seed.
        count = 2 + len(self.config.policies) * len(self.seeds)
        if not is_surrogate(self.plant):
            # Collect, fit, and evaluate in the surrogate.
            count += 3
        if self.config.evaluate.trim is not None:
            count += 1
        return count

    def learn_surrogate(self) -> JsonObject | None:
        """Collect logs and fit the surrogate; returns the scores of Table I."""
        # The run's seed replaces the seed in the configuration of the stage.
        settings = self.config.collect.merged({"seed": self.seed}, "seed")
        minutes = settings.logs * settings.rows / (60 * RATE_HZ)
        what = (
            f"{minutes:.3g} minutes of random strokes of the fin and the resulting force, "
            f"{settings.logs} logs"
        )
        self.stage("collect", what, self.dataset, collect, self.plant, self.dataset, settings)
        what = (
            "a surrogate: neural networks that predict the fin's motion and force from its commands"
        )
        # `resume` continues an interrupted fit and otherwise starts one. Errors are ignored because
        # the logs were recorded by this run and not by a user's program.
        options = {"seed": self.seed, "resume": True, "ignore_errors": True}
        self.stage(
            "fit",
            what,
            self.surrogate,
            fit,
            self.dataset,
            self.surrogate,
            self.config.fit,
            **options,
        )
        scores: JsonObject | None = artifacts.load_description(self.surrogate, "surrogate")[
            "scores"
        ]
        return scores

    def make_controllers(self) -> None:
        """Produce the controller of gaits, and policies of each kind from each seed."""
        surrogate = str(self.surrogate)
        gaits = self.out / "gaits"
        what = (
            "the controller gaits: the mean forces that the fin can produce in the surrogate, and "
            "the gaits (six actions each) that produce them"
        )
        self.stage("map", what, gaits, map_forces, surrogate, gaits, self.config.gaits)
        for kind, config in self.config.policies.items():
            policies = "one recurrent policy" if kind == "single" else "a recurrent policy per cell"
            for seed in self.seeds:
                out = self.controller(kind, seed)
                what = (
                    f"the controller {kind}: {policies}, trained in the surrogate by LSTM-PPO, "
                    f"{config.steps:,} actions each, seed {seed}"
                )
                options = {"seed": seed, "resume": True}
                self.stage(f"train {out.name}", what, out, train, surrogate, out, config, **options)

    def controller(self, kind: str, seed: int) -> Path:
        """Return the folder of the controller trained from a seed; there is only one for gaits."""
        if kind == "gaits" or len(self.seeds) == 1:
            return self.out / kind
        return self.out / f"{kind}-{seed}"

    def make_page(self) -> None:
        """Write the page for trying the controllers of the first seed, if it can simulate a plant
        of this run."""
        # The plant of this run may itself be the surrogate's folder, perhaps spelled differently.
        places = {Path(name).resolve(): name for name in (str(self.surrogate), self.plant)}
        plants = [name for name in reversed(places.values()) if is_shown(find_plant(name))]
        if not plants:
            return
        what = "a page to drag the target force and watch these controllers follow it"
        controllers = [self.controller(kind, self.seed) for kind in self.config.kinds]
        with self.timed("explore", what):
            explore(controllers, self.out / PAGE, plants, overwrite=True)
        self.stages[-1]["page"] = PAGE

    def evaluate(
        self, plant: str, folder: str, *, trim: bool = False, moving: bool = True
    ) -> Evaluated:
        """Evaluate all controllers on a plant; for each kind, the seeds are combined into one
        evaluation."""
        where = {str(self.surrogate): "the surrogate", "tank": "the virtual tank"}.get(plant, plant)
        what = f"evaluation of these controllers in {where}"
        if trim:
            what += ", with force feedback (--trim)"
        evaluated = Evaluated()
        changes: JsonObject = {} if trim else {"trim": None}
        if not moving:
            changes |= {"moving": False, "recorded": None}
        with self.timed(folder, what):
            target = find_plant(plant)
            progress = self.begin(folder)
            for place, kind in enumerate(self.config.kinds, start=1):
                each = []
                for seed in self.seeds:
                    path = self.controller(kind, seed)
                    config = self.config.evaluate.model_copy(update=changes | {"seed": seed})
                    controller = load_controller(path)
                    check_limits(controller.limits, target.limits, path, plant)
                    each.append(score_controller(controller, target, config))
                # Not reported per seed: the first one compiles the program that the others share.
                progress(folder, place / len(self.config.kinds), kind)
                whole = together(each)
                repetitions = (
                    "of the plant's noise"
                    if kind == "gaits"
                    else "controllers trained from different seeds"
                )
                metadata = {"controller": kind, "plant": plant, "repetitions": repetitions}
                evaluated[kind] = (
                    write_evaluation(whole, self.out / folder / kind, metadata, overwrite=True),
                    whole,
                )
        return evaluated

    def figures(
        self, results: RunResults, evaluated: Evaluated, shown: Evaluated
    ) -> dict[str, dict[str, Figure]]:
        """Draw the report's figures by section; the moving references are those of `shown`."""
        figures: dict[str, dict[str, Figure]] = {
            "surrogate": {} if results["surrogate"] is None else self.surrogate_figures(),
            "learning": self.learning_figures(),
            "experiment": {},
            "moving": {},
        }
        for kind, (_, evaluation) in evaluated.items():
            caption = f"{kind} controller, seed {self.seed}"
            figures["experiment"][caption] = experiments_figure(evaluation.recording)
        for kind, (_, evaluation) in shown.items():
            for moving in evaluation.moving:
                caption = f"{kind} controller, seed {self.seed}, {moving.plan.name}"
                figures["moving"][caption] = moving_figure(moving)
        return figures

    def learning_figures(self) -> dict[str, Figure]:
        """Draw the reward, and the error without exploration noise, over the training steps."""
        if not self.config.policies:
            return {}
        rewards: dict[str, list[Curve]] = {}
        errors: dict[str, list[Curve]] = {}
        for kind in self.config.policies:
            folders = [self.controller(kind, seed) for seed in self.seeds]
            logs = [read_training_log(folder / TRAINING_LOG / LOG) for folder in folders]
            rewards[kind] = [learning_curve(log, "reward") for log in logs]
            errors[kind] = [learning_curve(log, "score_x_n", "score_y_n") for log in logs]
        return {
            "Mean reward per step during exploration": learning_figure(
                rewards, "mean reward per step [N]"
            ),
            "Mean error of the policies without exploration noise, over both axes": learning_figure(
                errors, "error without noise [N]"
            ),
        }

    def surrogate_figures(self) -> dict[str, Figure]:
        """Draw a segment of a test log and the surrogate's prediction of it."""
        data = Dataset.open(self.dataset)
        surrogate = load_surrogate(self.surrogate)
        if not data.test:
            return {}
        log = next(data.load(data.test[:1]))
        rows = len(log.reading.time)
        # Start late enough to fill the surrogate's memory.
        first = max(surrogate.memory, min(10 * RATE_HZ, rows // 2))
        ticks = min(SHOWN_TEST_S * RATE_HZ, rows - first)
        stretch = slice(first, first + ticks)
        state = surrogate.warm(jax.tree.map(lambda x: x[first - surrogate.memory : first], log))
        # The reading of row k follows the command of row k - 1.
        commands = jax.tree.map(lambda x: x[first - 1 : stretch.stop - 1], log.command)
        _, free = eqx.filter_jit(roll)(surrogate, state, commands)
        predicted = {"free-running": np.asarray(free.force)}
        if isinstance(surrogate, Surrogate):
            (force,) = surrogate.predictions([log])["forcenet_measured"].series
            # The first rows of the log have no prediction.
            shift = rows - len(force)
            given = force[first - shift : stretch.stop - shift]
            predicted = {"given the angle": given, **predicted}
        return {
            "Force in a test log and in the surrogate": prediction_figure(
                np.asarray(log.reading.force[stretch]), predicted, first / RATE_HZ
            )
        }


def _peak_memory_gib() -> float:
    """Return the peak resident memory of this process so far [GiB]."""
    # macOS reports bytes, Linux kibibytes.
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (2**30 if sys.platform == "darwin" else 2**20)
