"""Parts about controllers and baselines."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from results.parts.common import (
    PAPER_BOX,
    POLICIES,
    PUBLISHED,
    TINY_MAP,
    TINY_NETS,
    TORQUE_ONLY,
    Figures,
    Part,
    Work,
    dataset,
    evaluate,
    evaluation_seed,
    families_before,
    find_gaits_at,
    make_controller,
    names_of,
    pair,
    paper,
    step_times,
    streaming,
    train,
)
from results.record import figure
from results.steps import Step, step

JUDGED = "--repeats 1 --moving --random 100"
"""Options of the evaluation in the published surrogate, which has no randomness."""


def controllers_published(seeds: Sequence[int]) -> Part:
    """Gaits and policies with the default budget, in the authors' published surrogate."""
    kinds = ("gaits", "single", "grid")
    pictures = {
        "docs/experiments.png": "judged-gaits-published/experiments.png",
    }
    part = _in_published("Controllers in the published surrogate", kinds, seeds)
    return part._replace(pictures=pictures)


def ppo_published(seeds: Sequence[int]) -> Part:
    """LSTM-PPO with the paper's budgets, in the authors' published surrogate."""
    return _in_published("LSTM-PPO in the published surrogate", ("single-ppo", "grid-ppo"), seeds)


def _in_published(title: str, kinds: Sequence[str], seeds: Sequence[int]) -> Part:
    trained = dict[str, list[Step]]()
    judged = dict[str, list[Step]]()
    for kind in kinds:
        own = (None,) if kind == "gaits" else seeds
        trained[kind] = [make_controller(kind, "published", seed) for seed in own]
        judged[kind] = [
            evaluate(each, "published", "judged", JUDGED, 0.5) for each in trained[kind]
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
                drawn = [row["random"][f"{score}_n"] for row in rows]
                figures[f"{kind}.random_{score}"] = figure("N", drawn, own, summary)
            step_times(figures, kind, rows, own)
        return figures

    steps = (PUBLISHED, *(each for kind in kinds for each in (*trained[kind], *judged[kind])))
    return Part(title, steps, read)


def controllers_tank(seeds: Sequence[int]) -> Part:
    """All controllers from streaming surrogates of the tank in the tank."""
    kinds = ("gaits", "single", "grid", "single-ppo", "grid-ppo")
    ways = {
        "tank": "--moving",
        "tank-feedback": "--feedback",
        "perturbed": "--randomize 0.15 --repeats 20",
        "perturbed-feedback": "--randomize 0.15 --repeats 20 --feedback --moving",
        "tank-torque": TORQUE_ONLY,
        "perturbed-torque": f"--randomize 0.15 --repeats 20 {TORQUE_ONLY} --moving",
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
            trained = make_controller(kind, f"{model}-{seed}", seed)
            plants = {"within": f"{model}-{seed}"}
            judged = [
                evaluate(trained, plants.get(name, "tank"), name, way, 0.5)
                for name, way in _ways_of(kind, ways).items()
            ]
            steps += [trained, *families_before(judged, trained), *judged]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for kind in kinds:
            for way in _ways_of(kind, ways):
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


def _ways_of(kind: str, ways: Mapping[str, str]) -> dict[str, str]:
    """Only gaits are judged without a force sensor."""
    return {name: way for name, way in ways.items() if kind == "gaits" or TORQUE_ONLY not in way}


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


WEIGHT = 0.3
"""Weight of the power [N/W] that docs/power.md recommends."""


def power(seeds: Sequence[int]) -> Part:
    """Gaits and policies with and without power in their objective, from logs with torque."""
    steps: list[Step] = []
    predicted: list[Step] = []
    controllers: dict[str, list[Step]] = {
        kind: [] for kind in ("gaits", "gaits-power", "single", "single-power")
    }
    for seed in seeds:
        logs = dataset(seed, "torque-logs", "--channels true")
        model = f"torque-{seed}"
        steps += [logs, step(model, f"softfin fit {logs.name} --seed {seed}", 3, seed, TINY_NETS)]
        unseen = dataset(700 + seed, "torque-logs", "--channels true")._replace(seed=seed)
        name = f"power-{model}"
        predicted.append(
            step(name, f"python -m results.scripts power {model} {unseen.name} {name}", 0.5, seed)
        )
        steps += [unseen, predicted[-1]]
        options, minutes = POLICIES["single-ppo"]
        for ending, weight, in_reward in (
            ("", "", ""),
            ("-power", f" --power {WEIGHT}", f" --task.reward.power {WEIGHT}"),
        ):
            kind = f"gaits{ending}"
            search = step(f"{kind}-{model}", f"softfin map {model}{weight}", 2, seed, TINY_MAP)
            controllers[kind].append(search)
            kind = f"single{ending}"
            controllers[kind].append(train(kind, options + in_reward, model, seed, minutes))
    judged = {
        kind: [evaluate(each, "tank", "power", "", 0.5) for each in those]
        for kind, those in controllers.items()
    }
    shown = {
        "default map": "gaits",
        "map with --power": "gaits-power",
        "LSTM-PPO": "single",
        "LSTM-PPO with power": "single-power",
    }
    named = {label: controllers[kind][0].name for label, kind in shown.items()}
    words = " ".join(f"'{label}={name}'" for label, name in named.items())
    drawn = step(
        "power-figure",
        f"python -m studies.power power.png {words}",
        3,
        after=tuple(named.values()),
    )

    def read(work: Work) -> Figures:
        figures: Figures = {}
        found = {kind: work.evaluations(names_of(those)) for kind, those in judged.items()}
        for kind, rows in found.items():
            figures[f"{kind}.error"] = figure("N", [pair(row["mean"]) for row in rows], seeds)
            figures[f"{kind}.std"] = figure(
                "N", [pair(row["mean"], "std_n") for row in rows], seeds
            )
            # The mean of the ratios, not the ratio of the means.
            ratios: dict[str, list[list[float]]] = {"mechanical": [], "electrical": []}
            for index, row in enumerate(rows[0]["references"]):
                where = "{:g},{:g}".format(*row["reference_n"])
                for power, those in ratios.items():
                    watts, before = (
                        [each["references"][index]["power"][power]["mean_w"] for each in some]
                        for some in (rows, found["gaits"])
                    )
                    figures[f"{kind}.{power}.{where}"] = figure("W", watts, seeds)
                    those.append([one / other for one, other in zip(watts, before, strict=True)])
                    figures[f"{kind}.{power}.ratio.{where}"] = figure("", those[-1], seeds)
            for power, those in ratios.items():
                means = np.mean(those, axis=0).tolist()
                figures[f"{kind}.{power}.ratio"] = figure("", means, seeds)
        scores = [work.json(f"{name}/power.json") for name in names_of(predicted)]
        figures["predicted.log_error"] = figure(
            "%", [100 * each["log_error"] for each in scores], seeds, "worst"
        )
        figures["predicted.coverage"] = figure(
            "%", [100 * each["coverage"] for each in scores], seeds
        )
        return figures

    return Part(
        "Force per watt",
        (
            *steps,
            *(each for those in (*controllers.values(), *judged.values()) for each in those),
            drawn,
        ),
        read,
        {"docs/power.png": "power.png"},
    )


def choices(seeds: Sequence[int]) -> Part:
    """Lattices of gaits, in the published surrogate."""
    coarse = step(
        "coarse-gaits-published",
        f"softfin map published {PAPER_BOX} --gaits.halvings 0",
        1,
        tiny=TINY_MAP,
    )
    judged = evaluate(coarse, "published", "judged", JUDGED, 0.5)

    def read(work: Work) -> Figures:
        figures: Figures = {}
        (row,) = work.evaluations([judged.name])
        figures["coarse-gaits.error"] = figure("N", [pair(row["mean"])], (0,))
        for score in ("mean", "worst"):
            drawn = [row["random"][f"{score}_n"]]
            figures[f"coarse-gaits.random_{score}"] = figure("N", drawn, (0,), score)
        step_times(figures, "coarse-gaits", [row], (0,))
        return figures

    return Part("Lattices of gaits", (PUBLISHED, coarse, judged), read)


def whole_map(seeds: Sequence[int]) -> Part:
    """Gaits for all that the fin can do, at random references."""
    gaits = step("map-gaits", "softfin map published", 3, tiny=TINY_MAP)
    judged = evaluate(gaits, "published", "judged", "--repeats 1 --random 100", 1)

    def read(work: Work) -> Figures:
        figures = {"map_s": work.spent([[gaits.name]], (0,))}
        (row,) = work.evaluations([judged.name])
        for score in ("mean", "worst"):
            drawn = [row["random"][f"{score}_n"]]
            figures[f"gaits.random_{score}"] = figure("N", drawn, (0,), score)
        return figures

    return Part(
        "Gaits over the whole reach of the published surrogate", (PUBLISHED, gaits, judged), read
    )


CLOCKS = ("3,2", "4,1.5", "6,1", "8,0.75", "10,0.6", "6,2")
"""Action rates [Hz] and windows [s] that are compared: windows of six actions, and of 2 s."""
REPEATED_CLOCKS = ("3,2", "6,1", "10,0.6")
"""Clocks that are compared with every seed."""


def faster(seeds: Sequence[int]) -> Part:
    """Settling time of gaits against ripple, with other action rates and windows."""
    trained = {
        clock: [
            find_gaits_at(clock, f"streaming-{seed}", seed)
            for seed in (seeds if clock in REPEATED_CLOCKS else seeds[:1])
        ]
        for clock in CLOCKS
    }
    options = "--repeats 1 --moving"
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
