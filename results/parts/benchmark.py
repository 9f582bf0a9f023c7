"""Parts that run the benchmark: the rows of its table, and the same for fins of other sizes."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from results.parts.common import (
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
    "single": (30_000, 100_000, 300_000),
    # As many in all six cells, and as many in each of them, as those of a single policy; 300,000 in
    # each would take an hour.
    "grid": (5_000, 16_700, 50_000, 30_000, 100_000),
}
"""Actions of each policy."""

PAPER_PPO = {
    "single": "--ppo.num-envs 32 --ppo.num-epochs 8",
    "grid": "--ppo.num-envs 16 --ppo.num-epochs 10",
}
"""The paper's rollouts and epochs."""

RATES_HZ = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 0.9)
"""Rates of the frequency response in the table."""

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
        policies = {kind: make_controller(kind, surrogate.name, seed) for kind in BUDGETS}
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
            for score, (unit, find) in SCORES.items():
                # What a controller does not cover has no figure.
                with contextlib.suppress(KeyError):
                    values = [find(file["cases"]) for file in files]
                    figures[f"{kind}.{score}"] = figure(unit, values, seeds)
            made = [names_of(row.made) for row in those]
            figures[f"{kind}.processor"] = work.spent(made, seeds, "processor_s")
        return figures

    return Part(title, tuple(dict.fromkeys(steps)), read)


def _settling_s(cases: Mapping[str, Any]) -> Value:
    """The longest settling time of the steps; None if one does not settle."""
    rows = [row for row in cases["moving"]["rows"] if row["described"].startswith("step")]
    longest = [row["longest_settling_s"] for row in rows]
    return None if None in longest else max(longest)


def _turn_n(cases: Mapping[str, Any]) -> Value:
    """The larger error of both directions on each axis."""
    rows = [row for row in cases["moving"]["rows"] if "turn" in row["described"]]
    return [max(row[axis]["error_n"] for row in rows) for axis in "xy"]


def _perturbed_n(index: int) -> Callable[[Mapping[str, Any]], Value]:
    return lambda cases: pair(cases["perturbed"][index]["mean"])


def _changed_n(after_s: int) -> Callable[[Mapping[str, Any]], Value]:
    def find(cases: Mapping[str, Any]) -> Value:
        return {row["after_s"]: row["rms_n"] for row in cases["changed"]}[after_s]

    return find


def _response(motion: str, rate_hz: float, name: str) -> Callable[[Mapping[str, Any]], Value]:
    """Gain or phase of the force without the averaging; phases that lag by half a turn are on the
    same side, so that seeds have a mean."""

    def find(cases: Mapping[str, Any]) -> Value:
        rows = {row["rate_hz"]: row for row in cases["frequency"][motion]}
        if name == "gain":
            return rows[rate_hz]["force_gain"]
        return (rows[rate_hz]["force_phase_deg"] + 270) % 360 - 270

    return find


SCORES: Mapping[str, tuple[str, Callable[[Mapping[str, Any]], Value]]] = {
    "error": ("N", lambda cases: pair(cases["references"]["mean"])),
    "std": ("N", lambda cases: pair(cases["references"]["mean"], "std_n")),
    "power": ("W", lambda cases: cases["references"]["mean"]["power"]["electrical"]["mean_w"]),
    "reach": ("N", lambda cases: cases["references"]["conditions"]["reach_n"]),
    "settles": ("s", _settling_s),
    "turn": ("N", _turn_n),
    "perturbed-15": ("N", _perturbed_n(0)),
    "perturbed-30": ("N", _perturbed_n(1)),
    "changed-0": ("N", _changed_n(0)),
    "changed-6": ("N", _changed_n(6)),
    "changed-20": ("N", _changed_n(20)),
    **{
        f"{motion}.{name}.{rate_hz:g}": (unit, _response(motion, rate_hz, name))
        for motion in ("turn", "pulse")
        for name, unit in (("gain", ""), ("phase", "deg"))
        for rate_hz in RATES_HZ
    },
}
"""Unit of each score, and where it is in the cases of a ``benchmark.json``."""
