"""Parts about surrogates and the tank."""

import json
from collections.abc import Sequence

from results.parts.common import (
    PUBLISHED,
    Figures,
    Part,
    Work,
    dataset,
    names_of,
    paper,
    perturbed_tank_logs,
    same_tank_logs,
    scores_of,
    streaming,
)
from results.record import figure
from results.steps import step

ERRORS = {
    "angle_rmse": ("rad", 1, ("angle_rmse_rad",)),
    "force_rmse": ("N", 1, ("force_x_rmse_n", "force_y_rmse_n")),
    "mean_force": ("N", 1, ("mean_force_mae_n", "mean_force_p95_n")),
    "coverage": ("%", 100, ("coverage",)),
    "coverage_axes": ("%", 100, ("coverage_x", "coverage_y")),
}
"""Figures of a comparison: unit, factor, scores."""


def surrogates(seeds: Sequence[int]) -> Part:
    """Both surrogates on the same rows."""
    sets = {"same": ("same", ""), "other": ("perturbed", " --horizons 30")}
    fits = {
        "streaming": [streaming(seed) for seed in seeds],
        "paper": [paper(seed) for seed in seeds],
    }
    compared = [
        step(
            f"compare-{name}-{seed}",
            f"python -m studies.compare streaming-{seed} paper-{seed} --dataset {logs}-{seed} "
            f"--noise-floor tank --seed {seed}{horizons} --out compare-{name}-{seed}",
            1,
            seed,
            "--horizons 2",
        )
        for seed in seeds
        for name, (logs, horizons) in sets.items()
    ]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for name in sets:
            found = [work.json(f"compare-{name}-{seed}/comparison.json") for seed in seeds]
            for index, model in enumerate((*fits, "again")):
                scored = [[*each["surrogates"], each["noise_floor"]][index] for each in found]
                rows = [each["horizons"][-1] for each in scored]
                for key, (unit, factor, scores) in ERRORS.items():
                    if scores[0] in rows[0]:
                        values = scores_of(rows, *scores, factor=factor)
                        figures[f"{model}.{name}.{key}"] = figure(unit, values, seeds)
                if model in fits:
                    flops = [each["flops_per_tick"] for each in scored]
                    figures[f"{model}.flops"] = figure("FLOPs a tick", flops, seeds)
        for model, steps in fits.items():
            for key, kind in (
                ("fit", "wall_s"),
                ("fit_processor", "processor_s"),
                ("peak", "peak_gib"),
            ):
                figures[f"{model}.{key}"] = work.spent([[each.name] for each in steps], seeds, kind)
        return figures

    logs = [
        each
        for seed in seeds
        for each in (dataset(seed), *same_tank_logs(seed), perturbed_tank_logs(seed))
    ]
    steps = (*logs, *fits["streaming"], *fits["paper"], *compared)
    pictures = {"docs/surrogates.png": f"compare-same-{seeds[0]}/comparison.png"}
    return Part("Surrogates, free-running for 30 s", steps, read, pictures)


def ablation(seeds: Sequence[int]) -> Part:
    """What each part of the streaming surrogate is worth."""
    command = "python -m studies.ablation ablation-{0} --dataset dataset-{0} --seed {0}"
    tiny = "--minutes 1 --updates 2 --members 1 --batch 4 --horizon 2"
    steps = [step(f"ablation-{seed}", command.format(seed), 8, seed, tiny) for seed in seeds]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        found = [work.json(f"ablation-{seed}/ablation.json") for seed in seeds]
        for name, first in found[0].items():
            rows = [each[name] for each in found]
            for key in ("angle_rmse", "force_rmse", "mean_force"):
                unit, _, scores = ERRORS[key]
                figures[f"{name}.{key}"] = figure(unit, scores_of(rows, *scores), seeds)
            figures[f"{name}.flops"] = figure("FLOPs a tick", [first["flops_per_tick"]])
        return figures

    return Part("Parts of the streaming surrogate", (*map(dataset, seeds), *steps), read)


def data_efficiency(seeds: Sequence[int]) -> Part:
    """How long to record."""
    command = (
        "python -m studies.data_efficiency efficiency-{0} --minutes 2,5,10,30,100 --seeds {0} "
    )
    command += "--members 3 --drive-updates 300 --force-updates 800"
    tiny = "--minutes 2 --members 2 --force-updates 2 --drive-updates 2"
    runs = [step(f"efficiency-{seed}", command.format(seed), 12, seed, tiny) for seed in seeds]
    every = " ".join(names_of(runs))
    drawn = step("efficiency", f"python -m results.scripts efficiency efficiency {every}", 0.5)

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for case in sorted((work.folder / "efficiency" / "scores").iterdir()):
            files = sorted(case.glob("*.json"))
            own = [int(file.stem[5:]) for file in files]
            found = [json.loads(file.read_text()) for file in files]
            for name, scores in found[0].items():
                for score in scores:
                    values = [each[name].get(score) for each in found]
                    figures[f"{case.name}.{name}.{score}"] = figure("", values, own)
        return figures

    pictures = {"docs/data_efficiency.png": "efficiency/data_efficiency.png"}
    return Part("How long to record", (*runs, drawn), read, pictures)


def tank(seeds: Sequence[int]) -> Part:
    """The default tank against the published fin."""
    others = [11 + seed for seed in seeds]
    command = (
        "softfin calibrate published --velocity-rad-s '[0.5, 1.57]' --config docs/calibration.yaml "
        "--evaluations 0"
    )
    tiny = "--segments 10 --test-segments 2 --segment-s 6 --iterations 1 --step 0.3"
    fitted = step("calibration", command, 30, tiny=tiny)
    judged = step(
        "tank-r2",
        f"python -m results.scripts tank-r2 published tank-r2 {' '.join(map(str, others))}",
        10,
    )

    def read(work: Work) -> Figures:
        figures: Figures = {}
        calibration = work.json("calibration/calibration.json")
        found = work.json("tank-r2/r2.json")
        for name, row in calibration["parameters"].items():
            figures[f"value of {name}"] = figure(row["unit"], [row["value"]])
            figures[f"error of {name}"] = figure(row["unit"], [row["standard_error"]])
        for channel in ("angle", "force_x", "force_y"):
            figures[f"fitted.{channel}"] = figure(
                "R2", [calibration["scores"]["test"][channel]["r2"]]
            )
            for low, rows in found.items():
                figures[f"from_{low}.{channel}"] = figure("R2", scores_of(rows, channel), others)
        return figures

    return Part("The default tank against the published fin", (PUBLISHED, fitted, judged), read)
