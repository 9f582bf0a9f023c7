"""How fast a controller can react: settling time against ripple, with other action rates and other
windows.

    python studies/faster_reaction.py surrogate RUN

softfin acts 3 times a second and judges by the mean force over six actions, 2 s. Both are
constants, in `softfin.core.action_clock`: every row here is trained and judged in processes in
which they are others. Gaits are found by the mean over their six actions in each row; the policies
add to them what they learn by the mean over the window. All are judged in the tank, each policy
with the noise and drift of its own seed, gaits with those of the first seed. Writes
faster_reaction.json.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple


class Clock(NamedTuple):
    """Ticks of 10 ms that the actions of one second are held, and actions whose mean force
    counts."""

    ticks: tuple[int, ...]
    window: int

    @property
    def samples(self) -> int:
        """Samples of the window."""
        return sum(self.ticks) * self.window // len(self.ticks)


THREE = (33, 33, 34)
SIX = (17, 16, 17, 17, 16, 17)
ROWS = {
    f"{kind}, {name}": (kind, clock)
    for kind in ("gaits", "single")
    for name, clock in {
        "3 Hz, 2 s": Clock(THREE, 6),
        "3 Hz, 1 s": Clock(THREE, 3),
        "6 Hz, 1 s": Clock(SIX, 6),
    }.items()
}

BOX = "{low: [0.4, -1.6], high: [3.6, 1.6]}"
"""References that a single controller is trained for, its margin included [N]."""

UNDER = """
import softfin.core.action_clock as clock, sys
ticks, window = {clock}
clock.ACTION_TICKS, clock.MAX_ACTION_TICKS, clock.ACTION_RATE_HZ = ticks, max(ticks), float(len(ticks))
clock.WINDOW = sum(ticks) * window // len(ticks)
from softfin.cli import main
main(sys.argv[1:])
"""


def softfin(clock: Clock, *words: str) -> None:
    """Run a command of softfin under a clock."""
    subprocess.run([sys.executable, "-c", UNDER.format(clock=tuple(clock)), *words], check=True)


def judged(
    surrogate: Path, out: Path, kind: str, clock: Clock, seeds: range
) -> list[dict[str, Any]]:
    """Train and judge the controllers of a row; what is there from a run before is left as it
    is."""
    whole = clock._replace(window=6)
    trained = out / "controllers"
    force_map = out.parent / f"map-{len(clock.ticks)}-hz"
    if kind == "gaits" and not trained.exists():
        given = ("--controller", "gaits", "--range", "paper", "--out", str(trained))
        softfin(whole, "train", str(surrogate), *given)
    if kind == "single" and not force_map.exists():
        softfin(whole, "map", str(surrogate), "--set", f"box={BOX}", "--out", str(force_map))
    if kind == "single" and not trained.exists():
        # The task's window is a multiple of 8 samples.
        window = f"task.window_samples={clock.samples // 8 * 8}"
        softfin(
            clock,
            "train",
            str(surrogate),
            "--controller",
            "single",
            "--range",
            "paper",
            "--algorithm",
            "gradient",
            "--set",
            window,
            "--seed",
            str(seeds[0]),
            "--seeds",
            str(len(seeds)),
            "--map",
            str(force_map),
            "--out",
            str(trained),
        )
    if kind == "gaits" or len(seeds) == 1:
        controllers = {seeds[0]: trained}
    else:
        controllers = {seed: trained / f"seed-{seed}" for seed in seeds}
    return [
        score(one, out / f"evaluation-{seed}", clock, seed) for seed, one in controllers.items()
    ]


def score(controller: Path, out: Path, clock: Clock, seed: int) -> dict[str, Any]:
    """Error, ripple, and the longest settling time of four steps."""
    if not out.exists():
        softfin(
            clock,
            "evaluate",
            str(controller),
            "--plant",
            "tank",
            "--repeats",
            "1",
            "--seed",
            str(seed),
            "--moving",
            "step",
            "--out",
            str(out),
        )
    found = json.loads((out / "evaluation.json").read_text())
    steps = [row["longest_settling_s"] for row in found["moving"]]
    scores = {
        name: [found["mean"][axis][f"{name}_n"] for axis in "xy"]
        for name in ("error", "std", "raw_std")
    }
    return {"seed": seed, **scores, "settling_s": None if None in steps else max(steps)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("surrogate", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=5, help="number of policies in each row")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first")
    parser.add_argument("--tiny", action="store_true", help="gaits alone: does it work at all?")
    words = parser.parse_args()
    seeds = range(words.seed, words.seed + words.seeds)
    written: dict[str, list[dict[str, Any]]] = {}
    for name, (kind, clock) in ROWS.items():
        if words.tiny and kind != "gaits":
            continue
        folder = words.out / name.replace(", ", "-").replace(" ", "")
        written[name] = judged(words.surrogate, folder, kind, clock, seeds)
        sys.stdout.write(f"{name}: {json.dumps(written[name])}\n")
    (words.out / "faster_reaction.json").write_text(json.dumps(written))


if __name__ == "__main__":
    main()
