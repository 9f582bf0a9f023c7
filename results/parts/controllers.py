"""Parts about controllers and baselines."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from results.parts.common import (
    CONTROLLERS,
    PUBLISHED,
    TINY,
    Figures,
    Part,
    Work,
    dataset,
    evaluate,
    evaluation_seed,
    names_of,
    pair,
    paper,
    step_times,
    streaming,
    train,
)
from results.record import figure
from results.steps import Step, step

JUDGED = "--repeats 1 --moving step --random 100"
"""Options of the evaluation in the published surrogate, which has no randomness."""


def controllers_published(seeds: Sequence[int]) -> Part:
    """Gaits and controllers trained by gradients, in the authors' published surrogate."""
    pictures = {
        "docs/error_map.png": f"judged-single-published-{seeds[0]}/error_map.png",
        "docs/experiments.png": f"judged-grid-published-{seeds[0]}/experiments.png",
    }
    part = _in_published(
        "Controllers in the published surrogate", ("gaits", "single", "grid"), seeds
    )
    return part._replace(pictures=pictures)


def ppo_published(seeds: Sequence[int]) -> Part:
    """LSTM-PPO of the paper's budgets, plain and with hindsight relabelling, in the authors'
    published surrogate."""
    kinds = ("single-ppo", "grid-ppo", "single-hindsight", "grid-hindsight")
    return _in_published("LSTM-PPO in the published surrogate", kinds, seeds)


def _in_published(title: str, kinds: Sequence[str], seeds: Sequence[int]) -> Part:
    trained = dict[str, list[Step]]()
    judged = dict[str, list[Step]]()
    for kind in kinds:
        options, minutes = CONTROLLERS[kind]
        own = (None,) if kind == "gaits" else seeds
        trained[kind] = [train(kind, options, "published", seed, minutes) for seed in own]
        judged[kind] = [
            evaluate(each, "published", "judged", f"{JUDGED} --error-map", 0.5)
            for each in trained[kind]
        ]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for kind in kinds:
            own = [each.seed or 0 for each in trained[kind]]
            names = [[each.name] for each in trained[kind]]
            rows = work.evaluations(names_of(judged[kind]))
            figures[f"{kind}.error"] = figure("N", [pair(row["mean"]) for row in rows], own)
            figures[f"{kind}.trained_in"] = work.spent(names, own)
            figures[f"{kind}.processor"] = work.spent(names, own, "processor_s")
            for score, summary in (("mean", "mean"), ("worst", "worst")):
                drawn = [pair(row["random"], f"{score}_n") for row in rows]
                lattice = [[row["error_map"][f"{score}_{axis}_n"] for axis in "xy"] for row in rows]
                figures[f"{kind}.random_{score}"] = figure("N", drawn, own, summary)
                figures[f"{kind}.map_{score}"] = figure("N", lattice, own, summary)
            step_times(figures, kind, rows, own)
        return figures

    steps = (PUBLISHED, *(each for kind in kinds for each in (*trained[kind], *judged[kind])))
    return Part(title, steps, read)


def controllers_tank(seeds: Sequence[int]) -> Part:
    """All controllers from streaming surrogates of the tank in the tank."""
    kinds = ("gaits", "single", "grid", "single-ppo", "grid-ppo")
    ways = {
        "tank": "--moving step",
        "tank-feedback": "--trim",
        "perturbed": "--randomize 0.15 --repeats 20",
        "perturbed-feedback": "--randomize 0.15 --repeats 20 --trim --moving step",
    }
    return _in_tank(
        "Controllers from streaming surrogates in the tank",
        kinds,
        "streaming",
        streaming,
        seeds,
        ways,
    )


def controllers_paper(seeds: Sequence[int]) -> Part:
    """The paper's method in the tank: Tables I and II."""
    kinds = ("single-ppo", "grid-ppo")
    ways = {"within": "", "tank": ""}
    part = _in_tank("The paper's method in the tank", kinds, "paper", paper, seeds, ways)

    def read(work: Work) -> Figures:
        figures = part.figures(work)
        for way in ways:
            # Both are trained in the same surrogate and see the same noise, so the seeds are
            # compared in pairs.
            pairs = zip(
                figures[f"single-ppo.{way}"]["values"],
                figures[f"grid-ppo.{way}"]["values"],
                strict=True,
            )
            differences = [
                [one - other for one, other in zip(*each, strict=True)] for each in pairs
            ]
            figures[f"single_minus_grid.{way}"] = figure("N", differences, seeds)
        found = [work.json(f"paper-{seed}/surrogate.json")["scores"] for seed in seeds]
        for net in ("posnet", "forcenet_measured", "forcenet_free_running"):
            for scale, scores in (
                ("physical", ("rmse", "mae", "dtw_mae")),
                ("scaled", ("rmse", "mae")),
            ):
                for score in scores:
                    unit = "" if scale == "scaled" else "rad" if net == "posnet" else "N"
                    values = [each[net][scale][score] for each in found]
                    figures[f"{net}.{scale}_{score}"] = figure(unit, values, seeds)
        return figures

    return part._replace(figures=read)


def _in_tank(
    title: str,
    kinds: Sequence[str],
    model: str,
    fit: Callable[[int], Step],
    seeds: Sequence[int],
    ways: Mapping[str, str],
) -> Part:
    """Controllers trained in the surrogate of each seed, judged in some ways in the tank, or within
    that surrogate."""
    steps = []
    for seed in seeds:
        steps += [dataset(seed), fit(seed)]
        for kind in kinds:
            options, minutes = CONTROLLERS[kind]
            trained = train(kind, options, f"{model}-{seed}", seed, minutes)
            plants = {"within": f"{model}-{seed}"}
            judged = [
                evaluate(trained, plants.get(name, "tank"), name, way, 0.5)
                for name, way in ways.items()
            ]
            steps += [trained, *judged]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for kind in kinds:
            for way in ways:
                key = f"{kind}.{way}"
                rows = work.evaluations([f"{way}-{kind}-{model}-{seed}" for seed in seeds])
                figures[key] = figure("N", [pair(row["mean"]) for row in rows], seeds)
                if "reading_error_n" in rows[0]["mean"]["x"]:
                    readings = [pair(row["mean"], "reading_error_n") for row in rows]
                    figures[f"{key}.reading"] = figure("N", readings, seeds)
                if way.startswith("perturbed"):
                    # How much the tanks of one seed differ.
                    tanks = [np.asarray(pair(row["mean"], "error_seeds_n")) for row in rows]
                    quantiles = [np.quantile(each, 0.95, axis=1).tolist() for each in tanks]
                    figures[f"{key}.tanks_95"] = figure("N", quantiles, seeds)
                    worst = [each.max(axis=1).tolist() for each in tanks]
                    figures[f"{key}.tanks_worst"] = figure("N", worst, seeds, "worst")
                deviations = [pair(row["mean"], "std_n") for row in rows]
                figures[f"{key}.std"] = figure("N", deviations, seeds)
                for index, row in enumerate(rows[0]["references"]):
                    x, y = row["reference_n"]
                    own = [each["references"][index] for each in rows]
                    figures[f"{key}.{x:g},{y:g}"] = figure("N", [pair(each) for each in own], seeds)
                    figures[f"{key}.std.{x:g},{y:g}"] = figure(
                        "N", [pair(each, "std_n") for each in own], seeds
                    )
                if "moving" in rows[0]:
                    step_times(figures, key, rows, seeds)
        return figures

    return Part(title, tuple(steps), read)


def baselines_published(seeds: Sequence[int]) -> Part:
    """What needs no learning, in the published surrogate."""
    return _baselines("published", "--plant published", (PUBLISHED,), seeds)


def baselines_tank(seeds: Sequence[int]) -> Part:
    """What needs no learning, searched for in the surrogate of each seed, in the tank."""
    before = [each for seed in seeds for each in (dataset(seed), streaming(seed))]
    return _baselines("tank", "--plant tank --surrogate streaming-{}", before, seeds)


def _baselines(plant: str, options: str, before: Sequence[Step], seeds: Sequence[int]) -> Part:
    tiny = "--seconds 6 --repeats 1 --gaits 8 --refinements 0"
    steps = []
    for seed in seeds:
        name = f"baselines-{plant}-{seed}"
        command = (
            f"python -m studies.baselines {options.format(seed)} --seed {evaluation_seed(seed)} "
            f"--out {name}"
        )
        steps.append(step(name, command, 2, seed, tiny))
    return Part(f"Baselines, {plant}", (*before, *steps), lambda work: _means(work, plant, seeds))


def _means(work: Work, plant: str, seeds: Sequence[int]) -> Figures:
    found = [work.json(f"baselines-{plant}-{seed}/baselines.json") for seed in seeds]
    return {
        name: figure(
            "N", [pair(row[name]["mean"]) if name in row else None for row in found], seeds
        )
        for name in dict.fromkeys(name for row in found for name in row)
    }


def recurrent(seeds: Sequence[int]) -> Part:
    """RecurrentPPO with the library's defaults."""
    steps = []
    for seed in seeds:
        name = f"baselines-recurrent-{seed}"
        command = f"python -m results.scripts recurrent published {name} {seed}"
        steps.append(step(name, command, 12, seed, "128 6", "sb3_contrib"))

    def read(work: Work) -> Figures:
        return {"single.error": _means(work, "recurrent", seeds)["recurrent_ppo"]}

    return Part("RecurrentPPO of sb3-contrib", (PUBLISHED, *steps), read)


def choices(seeds: Sequence[int]) -> Part:
    """What single choices of training are worth, in the published surrogate."""
    variants = {
        "untrained": ("single", "--set steps=576 --set num_evaluations=1"),
        "no-gaits": ("single", "--set gradient.warm_start=false"),
    }
    trained = dict[str, list[Step]]()
    judged = dict[str, list[Step]]()
    for name, (kind, options) in variants.items():
        trained[name] = [
            train(name, f"{CONTROLLERS[kind][0]} {options}", "published", seed, 2) for seed in seeds
        ]
    options = "softfin train published --controller gaits --range paper --set gaits.halvings=0"
    trained["coarse-gaits"] = [step("coarse-gaits-published", options, 1, tiny=TINY["gaits"])]
    for name, those in trained.items():
        judged[name] = [evaluate(each, "published", "judged", JUDGED, 0.5) for each in those]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for name, those in judged.items():
            rows = work.evaluations(names_of(those))
            own = [each.seed or 0 for each in those]
            figures[f"{name}.error"] = figure("N", [pair(row["mean"]) for row in rows], own)
            for score in ("mean", "worst"):
                drawn = [pair(row["random"], f"{score}_n") for row in rows]
                figures[f"{name}.random_{score}"] = figure("N", drawn, own, score)
            step_times(figures, name, rows, own)
        return figures

    steps = (PUBLISHED, *(each for name in trained for each in (*trained[name], *judged[name])))
    return Part("Choices of training", steps, read)


def whole_map(seeds: Sequence[int]) -> Part:
    """Gaits and policies for all that the fin can do, at random references."""
    mapped = step("map", "softfin map published", 3, tiny=TINY["gaits"])
    gaits = step("map-gaits", "softfin train published --controller gaits --map map", 0.5)
    options = "--controller single --map map --range map"
    trained = {
        "gaits": [gaits],
        "single": [train("map-single", options, "published", seed, 2) for seed in seeds],
    }
    judged = {
        kind: [
            evaluate(each, "published", "judged", "--repeats 1 --random 100", 1) for each in those
        ]
        for kind, those in trained.items()
    }

    def read(work: Work) -> Figures:
        figures = {"map_s": work.spent([["map"]], (0,))}
        for kind, those in judged.items():
            rows = work.evaluations(names_of(those))
            own = [each.seed or 0 for each in those]
            for score in ("mean", "worst"):
                drawn = [pair(row["random"], f"{score}_n") for row in rows]
                figures[f"{kind}.random_{score}"] = figure("N", drawn, own, score)
        return figures

    steps = (
        PUBLISHED,
        mapped,
        *(each for kind in trained for each in (*trained[kind], *judged[kind])),
    )
    return Part("Over the whole map of the published surrogate", steps, read)


CLOCKS = ("3,2", "4,1.5", "6,1", "8,0.75", "10,0.6", "6,2")
"""Action rates [Hz] and windows [s] that are compared: windows of six actions, and of 2 s."""
REPEATED_CLOCKS = ("3,2", "6,1", "10,0.6")
"""Clocks that are trained with every seed."""


def faster(seeds: Sequence[int]) -> Part:
    """Settling time against ripple, with other action rates and windows."""
    trained = {
        clock: [
            train(
                f"clock-{clock.replace(',', '-')}",
                f"--controller single --clock {clock}",
                f"streaming-{seed}",
                seed,
                2,
            )
            for seed in (seeds if clock in REPEATED_CLOCKS else seeds[:1])
        ]
        for clock in CLOCKS
    }
    options = "--repeats 1 --moving step"
    judged = {
        clock: [evaluate(each, "tank", "judged-tank", options, 1) for each in those]
        for clock, those in trained.items()
    }

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for clock, those in judged.items():
            rows = work.evaluations(names_of(those))
            own = [each.seed or 0 for each in those]
            key = "{} Hz {} s".format(*clock.split(","))
            for score in ("error", "std", "raw_std"):
                figures[f"{key}.{score}"] = figure(
                    "N", [pair(row["mean"], f"{score}_n") for row in rows], own
                )
            reach = [row["conditions"]["reach_n"] for row in rows]
            figures[f"{key}.reach"] = figure("N", reach, own)
            step_times(figures, key, rows, own)
        return figures

    steps = (
        *(each for seed in seeds for each in (dataset(seed), streaming(seed))),
        *(each for clock in CLOCKS for each in (*trained[clock], *judged[clock])),
    )
    return Part("Other action rates and windows", steps, read)
