"""A whole day at the rig in some minutes, on emulated devices: every command as one would type it,
in one script.

    python examples/rig_day.py --out runs/day            # some minutes: errors in docs/rig.md
    python examples/rig_day.py --out runs/day --quick    # less: does every step work at all?

The devices are emulated in simulated time, so nothing depends on how busy the computer is.

At a real rig leave out `rig emulate`, write your own rig.yaml (docs/rig.md), and --yes.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

SOFTFIN = (sys.executable, "-m", "softfin.cli")
MOVES = ("--arm", "--yes")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/day"))
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.out.exists():
        raise SystemExit(f"{options.out}: exists already; give another --out, or remove it")
    options.out.mkdir(parents=True)
    os.chdir(options.out)
    day(options.quick)


def day(quick: bool) -> None:
    # Morning: does the drive stop by itself? Where is zero? Is all well?
    softfin("rig", "emulate")
    softfin("rig", "check", "--prove", *MOVES)
    softfin("rig", "zero", *MOVES)
    softfin("rig", "check")

    # Record, look, learn.
    amount = (
        ("--logs=3", "--test-logs=1", "--rows=1000")
        if quick
        else ("--logs=8", "--test-logs=2", "--rows=6000")
    )
    softfin("collect", "--plant", "rig", "--out", "dataset", *amount, *MOVES)
    softfin("inspect", "dataset-bags/train-0000.mcap")
    small = ("members=1", "drive_updates=150", "force_updates=300") if quick else ("members=3",)
    softfin("fit", "dataset", "--out", "surrogate", *settings(small))
    lattice = (
        ("box={low: [1, -1], high: [2, 0]}", "spacing_n=1")
        if quick
        else ("box={low: [0, -1], high: [2.5, 1]}",)
    )
    softfin("map", "surrogate", "--out", "controller", *settings(lattice))

    # Afternoon: hold forces, judge, hand on. The emulated fin is that of the default tank.
    few = ("--fins=20", "--nodes=3", "--nominal-nodes=3") if quick else ()
    softfin("family", "controller", "--plant", "tank", *few)
    amount = ("--seconds=5", "--repeats=1") if quick else ("--seconds=20", "--repeats=2")
    judged = ("evaluate", "controller", "--plant", "rig", "--reference=1.5,-0.5", "--feedback")
    softfin(*judged, "--out", "evaluation", *amount, *MOVES)
    torque_only = ("--feedback.uses=torque", "--out", "evaluation-torque")
    softfin(*judged, *torque_only, *amount, *MOVES)
    held = ("--reference=1.5,-0.5", "--seconds=5", "--feedback", "--bag", "run.mcap")
    softfin("run", "controller", *held, *MOVES)
    softfin("export", "controller", "--onnx", "controller.onnx")
    mean = json.loads(Path("evaluation/evaluation.json").read_text())["mean"]
    print(
        f"mean error on the emulated fin: {mean['x']['error_n']:.3f}, {mean['y']['error_n']:.3f} N"
    )


def softfin(*words: str) -> None:
    print("+ softfin", *words, flush=True)
    done = subprocess.run([*SOFTFIN, *words], check=False)
    if done.returncode:
        raise SystemExit(f"softfin {words[0]}: exit code {done.returncode}")


def settings(changes: tuple[str, ...]) -> list[str]:
    options = []
    for change in changes:
        path, _, value = change.partition("=")
        options.append(f"--{path.replace('_', '-')}={value}")
    return options


if __name__ == "__main__":
    main()
