"""How fast a controller can react: settling time against ripple, with other action rates and other windows.

    python docs/faster_reaction.py published RUN --seeds 0,1,2,3,4

softfin acts 3 times a second and judges by the mean force over six actions, 2 s. Both are constants, in
`softfin.core.action_clock`: every row here is trained and judged in processes in which they are others. Gaits are of
six actions, so there are none where the window has three. Prints a table as Markdown and writes faster_reaction.json.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Clock(NamedTuple):
    """Ticks of 10 ms that the actions of one second are held, and actions whose mean force counts."""

    ticks: tuple[int, ...]
    window: int

    @property
    def samples(self) -> int:
        """Samples of the window."""
        return sum(self.ticks) * self.window // len(self.ticks)

    def __str__(self) -> str:
        return f"{len(self.ticks)} actions a second, window {self.samples / 100:g} s"


THREE, SIX = (33, 33, 34), (17, 16, 17, 17, 16, 17)
POLICY = ("--controller", "single", "--algorithm", "gradient", "--set", "gradient.warm_start=false")
GAITS = ("--controller", "gaits")
ROWS = {
    "gaits, 3 Hz, 2 s": (Clock(THREE, 6), GAITS),
    "gaits, 6 Hz, 1 s": (Clock(SIX, 6), GAITS),
    "policy, 3 Hz, 2 s": (Clock(THREE, 6), POLICY),
    "policy, 3 Hz, 1 s": (Clock(THREE, 3), POLICY),
    "policy, 6 Hz, 1 s": (Clock(SIX, 6), POLICY),
    "policy, 6 Hz, 2 s": (Clock(SIX, 12), POLICY),
}  # fmt: skip

UNDER = """
import softfin.core.action_clock as clock, sys
ticks, window = {clock}
clock.ACTION_TICKS, clock.MOST_TICKS, clock.ACTION_RATE_HZ = ticks, max(ticks), float(len(ticks))
clock.CYCLE_ACTIONS, clock.WINDOW = window, sum(ticks) * window // len(ticks)
from softfin.cli import main
main(sys.argv[1:])
"""


def softfin(clock: Clock, *words: str) -> None:
    """Run a command of softfin under a clock."""
    subprocess.run([sys.executable, "-c", UNDER.format(clock=tuple(clock)), *words], check=True)


def judged(surrogate: Path, out: Path, clock: Clock, options: Sequence[str], seed: int) -> dict[str, Any]:
    """Train and judge one controller; what is there from a run before is left as it is."""
    controller, evaluation = out / "controller", out / "evaluation"
    # The task's window is a multiple of 8 samples.
    window = ("--set", f"task.window_samples={clock.samples // 8 * 8}") if options is POLICY else ()
    if not (controller / "controller.json").exists():
        softfin(clock, "train", str(surrogate), *options, *window, *(("--seed", str(seed)) if window else ()),
                "--out", str(controller), "--overwrite")  # fmt: skip
    if not (evaluation / "evaluation.json").exists():
        softfin(clock, "evaluate", str(controller), "--plant", str(surrogate), "--seeds", "1", "--moving", "step",
                "--out", str(evaluation), "--overwrite")  # fmt: skip
    found = json.loads((evaluation / "evaluation.json").read_text())
    mean = found["mean"]
    score = {name: float(np.mean([mean[axis][f"{name}_n"] for axis in "xy"])) for name in ("error", "std", "raw_std")}
    steps = [row["longest_settling_s"] for row in found["moving"]]
    return score | {"settling_s": None if None in steps else max(steps), "unsettled": steps.count(None)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("surrogate", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=lambda text: tuple(map(int, text.split(","))), default=(0,))
    words = parser.parse_args()
    written: dict[str, list[dict[str, Any]]] = {}
    for name, (clock, options) in ROWS.items():
        # Gaits are found without any chance.
        seeds = words.seeds[:1] if options is GAITS else words.seeds
        folders = [words.out / name.replace(", ", "-").replace(" ", "") / f"seed-{seed}" for seed in seeds]
        written[name] = [
            judged(words.surrogate, folder, clock, options, seed) for folder, seed in zip(folders, seeds, strict=True)
        ]
        sys.stdout.write(f"{name}: {json.dumps(written[name])}\n")
    (words.out / "faster_reaction.json").write_text(json.dumps(written))


if __name__ == "__main__":
    main()
