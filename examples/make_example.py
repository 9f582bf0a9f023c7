"""Makes the example that comes with softfin, src/softfin/example: trains it, scores it in the tank,
records a minute.

    python examples/make_example.py                        # some minutes on two cores
    python examples/make_example.py --work runs/example    # what is there is used; what is missing is made

`softfin example DIR` writes it elsewhere. Its README.md takes its figures from its example.json.
"""

import argparse
import hashlib
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from softfin.stages.example import EXAMPLE, EXAMPLE_KIND
from softfin.storage import artifact as artifacts
from softfin.storage.log_file import read_log

PARTS = {
    "surrogate": "run/surrogate",
    "gaits": "run/gaits",
    "single": "run/single",
    "grid": "grid",
}
"""Folders of the example, and where the commands write them."""

CONTROLLERS = ("gaits", "single", "grid")
RECORDING = "recordings/minute.csv"

MAKING = {
    "run": "softfin reproduce --preset demo --plant tank --out run",
    "run/gaits/family": "softfin family run/gaits",
    "grid": "softfin train run/surrogate --controller grid --out grid",
    "minute": "softfin collect --plant tank --logs 1 --test-logs 0 --rows 6000 --seed 60 --out "
    "minute",
}
SCORING = {
    f"{name}{ending}": f"softfin evaluate {PARTS[name]} --plant tank --repeats 5 "
    f"{ending and '--feedback '}--out {name}{ending}"
    for name in CONTROLLERS
    for ending in ("", "-feedback")
}
"""Commands by the folders that they write."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=Path("runs/example"))
    work = parser.parse_args().work
    work.mkdir(parents=True, exist_ok=True)
    scoring = {
        f"scores-{name}": command.replace("--out ", "--out scores-")
        for name, command in SCORING.items()
    }
    for folder, command in (MAKING | scoring).items():
        if not (work / folder).exists():
            print(f"+ {command}", flush=True)
            subprocess.run(
                [sys.executable, "-m", "softfin.cli", *shlex.split(command)[1:]],
                cwd=work,
                check=True,
            )
    # Before the example changes, which would count as a change of the commit.
    origin = artifacts.provenance()
    shutil.rmtree(EXAMPLE, ignore_errors=True)
    for name, source in PARTS.items():
        for file in (f"{'controller' if name in CONTROLLERS else name}.json", artifacts.WEIGHTS):
            copy(work / source / file, EXAMPLE / name / file)
    for file in ("family.json", artifacts.WEIGHTS):
        copy(work / PARTS["gaits"] / "family" / file, EXAMPLE / "gaits/family" / file)
    (EXAMPLE / RECORDING).parent.mkdir()
    (EXAMPLE / RECORDING).write_text(plain_csv(work / "minute/train/0000.parquet"))
    files = sorted(file for file in EXAMPLE.rglob("*") if file.is_file())
    description = {
        "commands": [*MAKING.values(), *scoring.values()],
        "errors": {name: errors(work / f"scores-{name}") for name in SCORING},
        "files": {file.relative_to(EXAMPLE).as_posix(): digest(file) for file in files},
        "provenance": origin,
    }
    (EXAMPLE / f"{EXAMPLE_KIND}.json").write_text(
        artifacts.encode_description(EXAMPLE_KIND, description)
    )
    (EXAMPLE / "README.md").write_text(readme(description))


def copy(source: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, place)


def digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def plain_csv(file: Path) -> str:
    """A log with the columns and units that a laboratory's own program would write."""
    log = read_log(file)
    angles = np.rad2deg([log.command.angle, log.command.velocity, log.reading.angle]).T
    rows = zip(log.reading.time, angles, log.reading.force, strict=True)
    lines = ["t [ms],cmd angle [deg],cmd velocity [deg/s],theta [deg],Fx [N],Fy [N]"]
    for time_s, (target, velocity, angle), (x, y) in rows:
        lines.append(f"{1000 * time_s:.0f},{target:.3f},{velocity:.2f},{angle:.3f},{x:.2f},{y:.2f}")
    return "\n".join(lines) + "\n"


def errors(folder: Path) -> dict[str, Any]:
    """Errors of one evaluation: mean over the references and the seeds, and half of its 95%
    interval; x, y."""
    evaluation = json.loads((folder / "evaluation.json").read_text())
    axes = [evaluation["mean"][axis] for axis in ("x", "y")]
    return {
        "error_n": [axis["error_n"] for axis in axes],
        # The interval is null if all seeds have the same error.
        "half_interval_n": [
            (high - low) / 2
            for low, high in (axis["error_interval_n"] or (0.0, 0.0) for axis in axes)
        ],
        **{name: evaluation["conditions"][name] for name in ("seeds", "duration_s")},
        "references_n": [row["reference_n"] for row in evaluation["references"]],
    }


def readme(description: dict[str, Any]) -> str:
    """The README of the example; every figure is from its description."""
    stated = {
        name: " / ".join(
            f"{mean:.3f} ± {half:.3f}" for mean, half in zip(*list(row.values())[:2], strict=True)
        )
        for name, row in description["errors"].items()
    }
    table = "\n".join(
        f"| `{name}` | {stated[name]} | {stated[f'{name}-feedback']} |" for name in CONTROLLERS
    )
    row = description["errors"]["gaits"]
    origin = description["provenance"]
    again = origin.get("feedback_measured", "")
    later = again and f"; the errors with feedback were measured again at commit {again}"
    references = ", ".join("({:g}, {:g})".format(*reference) for reference in row["references_n"])
    commands = "\n".join(f"    {command}" for command in description["commands"])
    return f"""# An example of the virtual tank

Small pre-trained controllers for the virtual tank, not for a real fin.

| folder | |
| --- | --- |
| `surrogate` | streaming ensemble of three, fitted to ten minutes of the tank |
| `gaits` | reachable mean forces of the fin in the surrogate, and gaits that produce them: a controller |
| `single` | one policy for all references, trained in the surrogate by LSTM-PPO |
| `grid` | a policy for each of six cells, trained in the same way |
| `{RECORDING}` | one minute of random motions with the columns of a laboratory's own program: ms, degrees, N |
| `example.json` | commands, errors, SHA-256 of each file, versions |

Try them:

    softfin evaluate gaits --plant tank --reference=2,-1 --repeats 1 --out evaluation
    softfin explore gaits --plant tank --plant surrogate --out explore.html
    softfin rig emulate && softfin rig check --prove --arm && softfin rig zero --arm
    softfin run gaits --reference=2,-1 --seconds 10 --arm
    softfin import-logs recordings --out dataset

Error of the true mean force in the tank, x / y in N: mean of |moving average over 200 samples - reference| over
{row["duration_s"]} s from rest, at the references {references}. ± is half of the 95% interval over {row["seeds"]} seeds
of the sensor's noise and drift. Without feedback a controller does not use the sensor, so its true error is
the same for every seed. Other logs or training runs would give a different error.

| | error | with feedback (`--feedback`) |
| --- | --- | --- |
{table}

`examples/make_example.py` made this folder with these commands (softfin {origin["softfin"]}, commit
{origin["git_commit"]}, {origin["created"][:10]}){later}:

{commands}
"""


if __name__ == "__main__":
    main()
