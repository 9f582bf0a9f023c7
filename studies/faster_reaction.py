"""How fast a controller can react: settling time against ripple, over action clocks.

    python studies/faster_reaction.py surrogate RUN

Finds gaits for each clock and, for some, trains single controllers as well. All are evaluated in
the tank by the true force, each policy with the noise and drift of its own seed, gaits with those
of the first seed. Writes faster_reaction.json; what an earlier run has finished is not repeated.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from softfin.control.store import load_controller
from softfin.core.action_clock import ActionClock
from softfin.core.quantities import AXES
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.gaits.force_map import MapConfig
from softfin.learning.configuration import choose_preset, fit_to_reach, for_clock
from softfin.stages.controllers import find_gaits, train
from softfin.storage.registry import find_plant

CLOCKS = {
    f"{rate_hz} Hz {window_s} s": ActionClock.at(rate_hz, window_s)
    for rate_hz, window_s in ((3, 2), (4, 1.5), (6, 1), (8, 0.75), (10, 0.6), (6, 2), (10, 2))
}
"""Clocks by name: windows of six actions, and of 2 s."""
TRAINED = ("3 Hz 2 s", "6 Hz 1 s", "10 Hz 0.6 s")
"""Clocks for which single controllers are trained too."""


def train_controllers(
    kind: str, clock: ActionClock, surrogate: Path, out: Path, seeds: Sequence[int]
) -> dict[int, Path]:
    """Return the folders of the controllers of one row by seed, training what is missing."""
    if kind == "gaits":
        if not out.exists():
            find_gaits(str(surrogate), out, MapConfig(clock=clock))
        return {seeds[0]: out}
    if not out.exists():
        preset, _ = choose_preset(find_plant(str(surrogate)))
        make_config = partial(fit_to_reach, for_clock(preset, clock))
        train(str(surrogate), out, make_config, seeds=seeds, resume=True)
    if len(seeds) == 1:
        return {seeds[0]: out}
    return {seed: out / f"seed-{seed}" for seed in seeds}


def score(controller: Path, out: Path, seed: int) -> dict[str, Any]:
    """Return a controller's reach, error, ripple, and the longest settling time of four steps."""
    if out.exists():
        scores: dict[str, Any] = json.loads(out.read_text())
        return scores
    config = EvaluateConfig(seeds=1, seed=seed, moving=("step",))
    plant = find_plant("tank")
    summary = score_controller(load_controller(controller), plant, config).summary()
    steps = [row["longest_settling_s"] for row in summary["moving"]]
    scores = {
        "seed": seed,
        "reach": summary["conditions"]["reach_n"],
        **{
            name: [summary["mean"][axis][f"{name}_n"] for axis in AXES]
            for name in ("error", "std", "raw_std")
        },
        "settling": None if None in steps else max(steps),
    }
    out.write_text(json.dumps(scores))
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("surrogate", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=5, help="number of policies per row")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--tiny", action="store_true", help="only gaits at 3 and 6 Hz, for a test")
    words = parser.parse_args()
    seeds = range(words.seed, words.seed + words.seeds)
    rows = [("gaits", name) for name in CLOCKS] + [("single", name) for name in TRAINED]
    if words.tiny:
        rows = [("gaits", name) for name in TRAINED[:2]]
    written: dict[str, list[dict[str, Any]]] = {}
    for kind, name in rows:
        key = f"{kind} {name}"
        folder = words.out / key.replace(" ", "-")
        controllers = train_controllers(
            kind, CLOCKS[name], words.surrogate, folder / "controllers", seeds
        )
        written[key] = [
            score(controller, folder / f"scores-{seed}.json", seed)
            for seed, controller in controllers.items()
        ]
        sys.stdout.write(f"{key}: {json.dumps(written[key])}\n")
        sys.stdout.flush()
        (words.out / "faster_reaction.json").write_text(json.dumps(written))


if __name__ == "__main__":
    main()
