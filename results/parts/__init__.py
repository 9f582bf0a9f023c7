"""The parts: the steps of each, and how its figures are read from what these wrote; each is a
``results/NAME.json``."""

import json
from collections.abc import Callable, Sequence

from results.parts.benchmark import benchmark, benchmark_recurrent, fins
from results.parts.common import (
    TORQUE_ONLY,
    Figures,
    Part,
    Work,
    evaluation_seed,
    find_family,
    names_of,
    pair,
)
from results.parts.controllers import (
    baselines_published,
    baselines_tank,
    choices,
    controllers_paper,
    controllers_published,
    controllers_tank,
    faster,
    power,
    ppo_published,
    recurrent,
    whole_map,
)
from results.parts.robot import robot
from results.parts.surrogates import ablation, data_efficiency, surrogates, tank
from results.record import figure
from results.steps import step

__all__ = ["BENCHMARKS", "PARTS", "SEEDS", "Part", "Work", "parts"]

SEEDS = (10, 11, 12, 13, 14)
"""No setting of softfin was chosen on these seeds; 0 to 9 were used while settings were chosen."""

BENCHMARKS = {
    "tank": (2, 5),
    "task": (2, 5),
    "surrogate": (1, 5),
    "fit": (2, 5),
    "ppo": (6, 3),
    "controllers": (7, 3),
    "cells": (3, 3),
    "compile": (6, 1),
    "memory": (6, 1),
    "logs": (3, 3),
    "controller_step": (1, 5),
    "recording": (1, 5),
    "rig": (3, 3),
    "rig_deaths": (60, 1),
    "activation": (8, 3),
    "robot": (1, 3),
    "explore": (1, 5),
}
"""Benchmarks: minutes of each run, and runs. Those of few runs take long, or count what hardly
varies."""


def demo(seeds: Sequence[int]) -> Part:
    """``make demo``, whose feedback has no family, and feedback with a family on its gaits."""
    # One seed is that of the whole chain here, the evaluation included.
    seeds = [evaluation_seed(seed) for seed in seeds]
    command = "softfin reproduce --preset demo --plant tank --seed"
    runs = [step(f"demo-{seed}", f"{command} {seed}", 2.5, seed) for seed in seeds]
    families = [find_family(run, "/gaits") for run in runs]
    ways = {"family": "--feedback", "torque": TORQUE_ONLY}
    judged = {
        way: [
            step(
                f"{way}-evaluation-demo-{seed}",
                f"softfin evaluate demo-{seed}/gaits --plant tank {options} --repeats 1 "
                f"--seed {seed}",
                0.5,
                seed,
                "--seconds 6",
                after=(found.name,),
            )
            for seed, found in zip(seeds, families, strict=True)
        ]
        for way, options in ways.items()
    }

    def read(work: Work) -> Figures:
        names = names_of(runs)
        found = [work.json(f"{run.name}/results.json") for run in runs]
        figures = {
            key: work.spent([[name] for name in names], seeds, key)
            for key in ("wall_s", "processor_s")
        }
        means = {
            f"{kind}.{key}": [row[name][kind]["mean"] for row in found]
            for key, name in (("error", "controllers"), ("feedback", "with_feedback"))
            for kind in found[0].get(name) or ()
        }
        for way, those in judged.items():
            rows = work.evaluations(names_of(those))
            means[f"gaits.{way}"] = [row["mean"] for row in rows]
        for key, scores in means.items():
            figures[key] = figure("N", [pair(mean) for mean in scores], seeds)
            readings = [pair(mean, "reading_error_n") for mean in scores]
            figures[f"{key}.reading"] = figure("N", readings, seeds)
        return figures

    steps = (*runs, *families, *(each for those in judged.values() for each in those))
    return Part("make demo", steps, read)


def rig_day(seeds: Sequence[int]) -> Part:
    """The day at an emulated rig."""
    day = step("rig-day", "python examples/rig_day.py --out rig-day", 20, tiny="--quick")

    def read(work: Work) -> Figures:
        folders = {"error": "evaluation", "torque": "evaluation-torque"}
        return {
            key: figure("N", [pair(work.json(f"rig-day/{folder}/evaluation.json")["mean"])])
            for key, folder in folders.items()
        }

    return Part("A day at an emulated rig", (day,), read)


def bench(name: str) -> Callable[[Sequence[int]], Part]:
    """A benchmark, each run in a process of its own."""

    def make(seeds: Sequence[int]) -> Part:
        extra = "sb3_contrib" if name == "ppo" else None
        (minutes, count) = BENCHMARKS[name]
        command = f"python -m benchmarks {name}"
        seeds = seeds[:count]
        runs = [step(f"bench-{name}-{seed}", command, minutes, seed, extra=extra) for seed in seeds]

        def read(work: Work) -> Figures:
            tables = [json.loads((work.folder / f"{run.name}.out").read_text()) for run in runs]
            figures: Figures = {}
            for rows in zip(*tables, strict=True):
                title = rows[0]["figure"].replace(":", "")
                for key in sorted(rows[0].keys() - {"met"}):
                    values = [row.get(key) for row in rows]
                    # A time of something that no run reached is no figure; one that some reached
                    # has nulls.
                    if any(isinstance(value, int | float) for value in values):
                        unit = rows[0].get("unit", "") if key == "value" else ""
                        name = title if key == "value" else f"{title}.{key}"
                        figures[name] = figure(
                            unit, values, seeds, "median", machine_dependent=True
                        )
            return figures

        return Part(f"Benchmark {name}", tuple(runs), read)

    return make


PARTS: dict[str, Callable[[Sequence[int]], Part]] = {
    "surrogates": surrogates,
    "controllers-published": controllers_published,
    "ppo-published": ppo_published,
    "controllers-tank": controllers_tank,
    "controllers-paper": controllers_paper,
    "baselines-published": baselines_published,
    "baselines-tank": baselines_tank,
    "recurrent": recurrent,
    "choices": choices,
    "whole-map": whole_map,
    "faster": faster,
    "power": power,
    "ablation": ablation,
    "data-efficiency": data_efficiency,
    "tank": tank,
    "demo": demo,
    "benchmark": benchmark,
    "benchmark-recurrent": benchmark_recurrent,
    "fins": fins,
    "rig-day": rig_day,
    "robot": robot,
    **{f"bench-{name.replace('_', '-')}": bench(name) for name in BENCHMARKS},
}
"""Parts by name, in the order in which they are run."""


def parts(seeds: Sequence[int] = SEEDS) -> dict[str, Part]:
    """All parts over some seeds."""
    return {name: make(seeds) for name, make in PARTS.items()}
