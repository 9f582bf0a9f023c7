"""What parts are made of: steps that several share, and how their files are read.

Names end in the seed. Whole chains are repeated. In the chain of seed N the logs, the surrogate
that is fitted to them and the controllers that are trained in it come from N; the tanks, noise and
drift of their evaluation, and the search of baselines, come from `evaluation_seed` of N.
RecurrentPPO evaluates with N itself.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from results.record import Value, figure
from results.steps import Step, step

Figures = dict[str, dict[str, Any]]


class Work(NamedTuple):
    """The folder in which all steps ran."""

    folder: Path

    def json(self, path: str) -> Any:
        """A JSON file below it."""
        return json.loads((self.folder / path).read_text())

    def evaluations(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """The ``evaluation.json`` of some steps."""
        return [self.json(f"{name}/evaluation.json") for name in names]

    def spent(
        self, steps: Sequence[Sequence[str]], seeds: Sequence[int], kind: str = "wall_s"
    ) -> dict[str, Any]:
        """Wall or processor time [s], or peak memory [GiB], of the steps of each seed.

        Seeds of which a step was stopped in between are left out: what it took before is not known.
        """
        records = [[self.json(f"{name}.step.json") for name in names] for names in steps]
        whole = [
            (seed, each)
            for seed, each in zip(seeds, records, strict=True)
            if not any(r["resumed"] for r in each)
        ]
        values = [round(sum(record[kind] for record in each), 2) for _, each in whole]
        unit = "GiB" if kind == "peak_gib" else "s"
        return figure(unit, values, [seed for seed, _ in whole], "median", machine_dependent=True)


class Part(NamedTuple):
    """One JSON."""

    title: str
    steps: tuple[Step, ...]
    figures: Callable[[Work], Figures]
    pictures: Mapping[str, str] = {}
    """Pictures of docs, and where the steps write them."""


def names_of(steps: Sequence[Step]) -> list[str]:
    """The names of some steps."""
    return [each.name for each in steps]


def pair(row: Mapping[str, Any], name: str = "error_n") -> list[float]:
    """x and y of a score."""
    return [row["x"][name], row["y"][name]]


def scores_of(rows: Sequence[Mapping[str, Any]], *scores: str, factor: float = 1) -> list[Value]:
    """One score of each row, or two."""
    values = [[factor * row[score] for score in scores] for row in rows]
    return [value if len(value) > 1 else value[0] for value in values]


def step_times(
    figures: Figures, key: str, judged: Sequence[Mapping[str, Any]], seeds: Sequence[int]
) -> None:
    """Add the settling time of each of the default steps, and the longest, at the slowest of the
    plant's seeds."""
    rows = [[row["longest_settling_s"] for row in each["moving"]] for each in judged]
    for index in range(len(rows[0])):
        figures[f"{key}.step_{index + 1}"] = figure(
            "s", [row[index] for row in rows], seeds, "median"
        )
    figures[f"{key}.settling"] = figure(
        "s", [None if None in row else max(row) for row in rows], seeds, "median"
    )


PUBLISHED = step(
    "published",
    "python examples/import_keras.py $SOFTFIN_PUBLISHED/cnn_pos_net.keras "
    "$SOFTFIN_PUBLISHED/lstm_force_net.keras --scalers $SOFTFIN_PUBLISHED/scalers.json "
    "--out published",
    0.2,
)


def dataset(seed: int, name: str = "dataset", options: str = "") -> Step:
    """Logs of a tank; by default, the paper's number of logs of the default tank."""
    options = options if "--plant" in options else f"--plant tank {options}"
    return step(
        f"{name}-{seed}",
        f"softfin collect {options} --seed {seed}",
        0.5,
        seed,
        "--logs 12 --test-logs 1 --rows 1500",
    )


def same_tank_logs(seed: int) -> tuple[Step, Step]:
    """Logs of the same tank that no surrogate has seen, as training logs and as the test logs of a
    dataset."""
    command = f"softfin collect --plant tank --logs 12 --test-logs 0 --seed {700 + seed}"
    collected = step(f"same-logs-{seed}", command, 1, seed, "--logs 2 --rows 1500")
    return collected, step(
        f"same-{seed}", f"python -m results.scripts as-test same-logs-{seed} same-{seed}", 0.2, seed
    )


def perturbed_tank_logs(seed: int) -> Step:
    """Logs of 120 perturbed tanks: so many show how often intervals hold, since drift is correlated
    within a log."""
    command = (
        f"softfin collect --plant tank --logs 1 --test-logs 120 --rows 3400 --seed {800 + seed}"
    )
    return step(f"perturbed-{seed}", command, 1, seed, "--test-logs 2 --rows 1500")


TINY_NETS = "--members 2 --drive-updates 60 --force-updates 120 --batch 8"
TINY_MAP = "--gaits.steps 6 --survey.directions 8 --survey.pushes 0 --spacing-n 1"
TINY_TRAINING = "--num-evaluations 1 --policy.units 8 --policy.width 8 --steps 960"


def streaming(seed: int) -> Step:
    """Fit of the streaming surrogate on the paper's rows."""
    return step(
        f"streaming-{seed}", f"softfin fit dataset-{seed} --seed {seed}", 3, seed, TINY_NETS
    )


def paper(seed: int) -> Step:
    """Fit of the paper's nets on the same rows."""
    command = f"softfin fit dataset-{seed} --model paper --seed {seed}"
    return step(f"paper-{seed}", command, 10, seed, "--epochs 1 --batch 64")


PAPER_BOX = "--box '{low: [0.5, -1.5], high: [3.5, 1.5]}' --spacing-n 0.55"
"""Gaits over the paper's range of references only."""

PAPER_PPO = {
    "single": "--ppo.num-envs 32 --ppo.num-epochs 8",
    "grid": "--ppo.num-envs 16 --ppo.num-epochs 10",
}
"""The paper's rollouts and epochs."""

POLICIES = {
    "single": ("--controller single", 1.5),
    "grid": ("--controller grid", 2),
    "single-ppo": (
        f"--controller single --range paper --steps 30000 {PAPER_PPO['single']}",
        0.7,
    ),
    "grid-ppo": (
        f"--controller grid --range paper --steps 10000 {PAPER_PPO['grid']}",
        1,
    ),
}
"""Policies with the default budget, and with the paper's: options of `softfin train`, and
minutes."""


def find_gaits(surrogate: str, seed: int | None, options: str = PAPER_BOX) -> Step:
    """Search for gaits, which has no randomness of its own."""
    return step(f"gaits-{surrogate}", f"softfin map {surrogate} {options}", 0.8, seed, TINY_MAP)


def find_gaits_at(clock: str, surrogate: str, seed: int) -> Step:
    """Search for gaits with another action rate and window, such as ``6,1``."""
    name = f"clock-{clock.replace(',', '-')}-{surrogate}"
    return step(name, f"softfin map {surrogate} --clock {clock}", 2, seed, TINY_MAP)


def train(kind: str, options: str, surrogate: str, seed: int, minutes: float) -> Step:
    """Training of policies."""
    name = f"{kind}-{surrogate}"
    if not surrogate.endswith(f"-{seed}"):
        name += f"-{seed}"
    command = f"softfin train {surrogate} {options} --seed {seed}"
    return step(name, command, minutes, seed, TINY_TRAINING)


def make_controller(kind: str, surrogate: str, seed: int | None) -> Step:
    """Gaits, or policies of a kind."""
    if kind == "gaits" or seed is None:
        return find_gaits(surrogate, seed)
    options, minutes = POLICIES[kind]
    return train(kind, options, surrogate, seed, minutes)


def evaluation_seed(seed: int) -> int:
    """Return the seed with which controllers and baselines of a chain are evaluated.

    Force feedback was tried out in tanks of smaller seeds, some of them seeds of chains.
    """
    return 100 + seed


def evaluate(controller: Step, plant: str, name: str, options: str, minutes: float) -> Step:
    """Evaluation of a trained controller, with the noise, drift and tanks of its seed; of gaits
    with feedback, after the step of `find_family`."""
    tiny = "--seconds 6 --random 3" if "--random" in options else "--seconds 6"
    seed = "" if controller.seed is None else f" --seed {evaluation_seed(controller.seed)}"
    command = f"softfin evaluate {controller.name} --plant {plant} {options}{seed}"
    # Policies have no family.
    has_family = "--feedback" in options and controller.program == "map"
    after = (_family_name(controller.name),) if has_family else ()
    return step(f"{name}-{controller.name}", command, minutes, controller.seed, tiny, after=after)


TORQUE_ONLY = "--feedback --feedback.uses torque"
"""Options of feedback without a force sensor."""


def find_family(controller: Step, folder: str = "", plant: str = "--plant tank") -> Step:
    """Search for the family of a controller in a tank, which is written into the folder of the
    controller; `folder` is its path below the result of the step."""
    words = ("softfin", "family", f"{controller.name}{folder}", *plant.split())
    tiny = ("--fins", "20", "--nodes", "3", "--nominal-nodes", "3")
    return Step(_family_name(controller.name), words, 1.5, controller.seed, tiny)


def families_before(judged: Sequence[Step], controller: Step) -> list[Step]:
    """The search for the family of a controller, if an evaluation needs it."""
    return [find_family(controller)] if any(each.after for each in judged) else []


def _family_name(controller: str) -> str:
    return f"family-{controller}"
