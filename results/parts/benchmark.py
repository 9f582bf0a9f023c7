"""Parts that run the benchmark: the rows of its table, and the same for fins of other sizes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from results.parts.common import (
    PAPER_PPO,
    TINY_MAP,
    TINY_NETS,
    Figures,
    Part,
    Work,
    dataset,
    find_family,
    find_gaits,
    find_gaits_at,
    make_controller,
    names_of,
    pair,
    streaming,
    train,
)
from results.record import Value, figure
from results.steps import Step, step

TINY_PROTOCOL = "--seconds 4 --seeds 1 --tanks 1 --change-s 6 --rates-hz '[0.1]'"

BUDGETS = {
    "single": (100_000, 300_000),
    # As many in all six cells, and as many in each of them, as those of a single policy; 300,000 in
    # each would take an hour.
    "grid": (5_000, 16_700, 50_000, 30_000, 100_000),
}
"""Actions of each policy, beside the paper's 30,000 of a single one."""

FINS = ("hand", "vehicle")
"""Fins of `examples/fins/`."""


class Row(NamedTuple):
    """One row and one seed of the table."""

    judged: Step
    made: tuple[Step, ...]
    """Steps that make the controller from logs."""


def benchmark(seeds: Sequence[int]) -> Part:
    """Baselines, gaits, and policies with several budgets, from the same surrogates."""
    rows = dict[str, list[Row]]()
    for kind in ("still", "inverse"):
        # They learn nothing from a surrogate.
        rows[kind] = [_other(kind, streaming(seeds[0]), ())]
    for seed in seeds:
        surrogate = streaming(seed)
        gaits = find_gaits(surrogate.name, seed)
        own: dict[str, Row] = {
            kind: _other(kind, surrogate, (surrogate,)) for kind in ("law", "sine")
        }
        own |= _with_gaits(surrogate, gaits, "--plant tank")
        faster = find_gaits_at("6,1", surrogate.name, seed)
        own["gaits-6-1"] = Row(_judge(faster), (surrogate, faster))
        named = {"single": "single", "grid": "grid", "single-30000": "single-ppo"}
        policies = {row: make_controller(kind, surrogate.name, seed) for row, kind in named.items()}
        for kind, budgets in BUDGETS.items():
            policies |= {
                f"{kind}-{actions}": _policy(kind, actions, surrogate.name, seed)
                for actions in budgets
            }
        own |= {kind: Row(_judge(policy), (surrogate, policy)) for kind, policy in policies.items()}
        for kind, row in own.items():
            rows.setdefault(kind, []).append(row)
    return _part("Benchmark", [dataset(seed) for seed in seeds], rows)


def benchmark_recurrent(seeds: Sequence[int]) -> Part:
    """RecurrentPPO of sb3-contrib with its defaults, 30,000 actions."""
    surrogates = [streaming(seed) for seed in seeds]
    rows = {"recurrent": [_other("recurrent", each, (each,)) for each in surrogates]}
    return _part("Benchmark of RecurrentPPO", [dataset(seed) for seed in seeds], rows)


def fins(seeds: Sequence[int]) -> Part:
    """Gaits with default options for fins of other sizes, with the clock of each."""
    rows = dict[str, list[Row]]()
    logs = []
    for seed in seeds:
        for fin in FINS:
            plant = f"--plant examples/fins/{fin}.yaml"
            logs.append(dataset(seed, f"dataset-{fin}", f"--logs 10 --rows 6000 {plant}"))
            fit = f"softfin fit {logs[-1].name} --seed {seed}"
            surrogate = step(f"surrogate-{fin}-{seed}", fit, 4, seed, TINY_NETS)
            for clock in ("paper", "auto"):
                command = f"softfin map {surrogate.name} --clock {clock}"
                gaits = step(f"gaits-{fin}-{clock}-{seed}", command, 2, seed, TINY_MAP)
                for kind, row in _with_gaits(surrogate, gaits, plant).items():
                    rows.setdefault(f"{fin}.{clock}.{kind}", []).append(row)
    return _part("Benchmark of fins of other sizes", logs, rows)


def _policy(kind: str, actions: int, surrogate: str, seed: int) -> Step:
    options = f"--controller {kind} --range paper --steps {actions} {PAPER_PPO[kind]}"
    minutes = 1 + actions * (6 if kind == "grid" else 1) / 150_000
    return train(f"{kind}-{actions}", options, surrogate, seed, minutes)


def _judge(controller: Step, options: str = "", after: tuple[str, ...] = ()) -> Step:
    name = f"benchmark{'-feedback' if after else ''}-{controller.name}"
    command = f"softfin benchmark {controller.name} {options}".rstrip()
    # The protocol has its own seed.
    return step(name, command, 1.5, controller.seed, TINY_PROTOCOL, after=after)


def _with_gaits(surrogate: Step, gaits: Step, plant: str) -> dict[str, Row]:
    """Rows of gaits without and with feedback."""
    family = find_family(gaits, plant=plant)
    return {
        "gaits": Row(_judge(gaits, plant), (surrogate, gaits)),
        "gaits-feedback": Row(
            _judge(gaits, f"{plant} --feedback", (family.name,)), (surrogate, gaits, family)
        ),
    }


def _other(kind: str, surrogate: Step, made: tuple[Step, ...]) -> Row:
    """Row of a controller that is not a folder; one step makes and judges it."""
    name = f"benchmark-{kind}-{surrogate.name}"
    command = f"python -m studies.benchmark_rows {kind} --surrogate {surrogate.name}"
    extra = "sb3_contrib" if kind == "recurrent" else None
    options = f"--seed {surrogate.seed} --out {name}"
    return Row(step(name, f"{command} {options}", 2, surrogate.seed, "--tiny", extra=extra), made)


def _part(title: str, logs: Sequence[Step], rows: Mapping[str, Sequence[Row]]) -> Part:
    steps = [*logs]
    for those in rows.values():
        for row in those:
            steps += [*row.made, row.judged]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for kind, those in rows.items():
            seeds = [row.judged.seed or 0 for row in those]
            files = [work.json(f"{row.judged.name}/benchmark.json") for row in those]
            judged = [file["cases"] for file in files]
            for score, (case, unit, find) in SCORES.items():
                if not any("not_covered" in cases[case] for cases in judged):
                    values = [find(cases[case]) for cases in judged]
                    figures[f"{kind}.{score}"] = figure(unit, values, seeds)
            if not any("not_covered" in cases["frequency"] for cases in judged):
                for score, unit, values in _responses([cases["frequency"] for cases in judged]):
                    figures[f"{kind}.{score}"] = figure(unit, values, seeds)
            made = [names_of(row.made) for row in those]
            figures[f"{kind}.processor"] = work.spent(made, seeds, "processor_s")
        return figures

    return Part(title, tuple(dict.fromkeys(steps)), read)


def _settling_s(case: Any) -> Value:
    """The longest settling time of the steps; None if one does not settle."""
    rows = [row for row in case["rows"] if row["described"].startswith("step")]
    longest = [row["longest_settling_s"] for row in rows]
    return None if None in longest else max(longest)


def _turn_n(case: Any) -> Value:
    """The larger error of both directions on each axis."""
    rows = [row for row in case["rows"] if "turn" in row["described"]]
    return [max(row[axis]["error_n"] for row in rows) for axis in "xy"]


def _changed_n(after_s: int) -> Callable[[Any], Value]:
    # The tiny protocol ends earlier.
    return lambda case: {row["after_s"]: row["rms_n"] for row in case}.get(after_s)


def _responses(cases: Sequence[Any]) -> Iterator[tuple[str, str, list[Value]]]:
    """Gain and phase of the force without the averaging, with their names and units; phases that
    lag by half a turn are on the same side, so that seeds have a mean."""
    for motion in ("turn", "pulse"):
        for rows in zip(*(case[motion] for case in cases), strict=True):
            rate = f"{rows[0]['rate_hz']:g}"
            yield f"{motion}.gain.{rate}", "", [row["force_gain"] for row in rows]
            phases = [row["force_phase_deg"] for row in rows]
            lags = [None if each is None else (each + 270) % 360 - 270 for each in phases]
            yield f"{motion}.phase.{rate}", "deg", lags


SCORES: Mapping[str, tuple[str, str, Callable[[Any], Value]]] = {
    "error": ("references", "N", lambda case: pair(case["mean"])),
    "std": ("references", "N", lambda case: pair(case["mean"], "std_n")),
    "power": ("references", "W", lambda case: case["mean"]["power"]["electrical"]["mean_w"]),
    "reach": ("references", "N", lambda case: case["conditions"]["reach_n"]),
    "settles": ("moving", "s", _settling_s),
    "turn": ("moving", "N", _turn_n),
    "perturbed-15": ("perturbed", "N", lambda case: pair(case[0]["mean"])),
    "perturbed-30": ("perturbed", "N", lambda case: pair(case[1]["mean"])),
    "changed-0": ("changed", "N", _changed_n(0)),
    "changed-6": ("changed", "N", _changed_n(6)),
    "changed-20": ("changed", "N", _changed_n(20)),
}
"""Case and unit of each score, and how it is read; a case that a controller does not cover has no
figure."""
