"""Runs what README and docs state: ``python -m results [PART[/SEED] ...] [--minutes N] [--again] [--tiny DIR]``.

Without a part it runs all whose JSON is not there, is carried over from before, or has another digest: over commands
and the code that they run. ``--list`` says which these are and how long they take. Each step is kept below
runs/results: a run that is stopped, by Ctrl-C or because the next step would pass ``--minutes``, goes on where it was.
``PART/3`` runs seed 3 alone; the JSON is written when all seeds are there. ``--write`` puts the figures into README
and docs.
"""

import argparse
import hashlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from results import ROOT, documents
from results.parts import PARTS, SEEDS, Part, Work, parts
from results.record import FOLDER, load, machine, write
from results.steps import Runner, Step

WORK = ROOT / "runs" / "results"
TINY_SEEDS = (0, 1)


def main() -> int:
    """Run, list or write; the exit code is 1 where something failed or could not be run."""
    parser = argparse.ArgumentParser(prog="python -m results", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("parts", nargs="*", help=", ".join(PARTS))
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no step that is expected to pass it")
    parser.add_argument("--again", action="store_true", help="run the steps of the named parts again")
    parser.add_argument("--tiny", type=Path, metavar="DIR", help="a few steps, two seeds, below DIR: does it all work?")
    parser.add_argument("--list", action="store_true", help="what there is, and what has to be run")
    parser.add_argument("--write", action="store_true", help="put the figures into README and docs")
    words = parser.parse_args()
    if words.write:
        for path in documents.write():
            say(f"{path.relative_to(ROOT)}: written")
        return 0
    tiny = words.tiny is not None
    table = parts(TINY_SEEDS if tiny else SEEDS)
    work, folder = (words.tiny / "work", words.tiny / "results") if tiny else (WORK, FOLDER)
    steps = {each.name: each for part in table.values() for each in part.steps}
    runner = Runner(work.absolute(), tuple(steps.values()), tiny)
    asked = [name.partition("/")[::2] for name in words.parts] or [
        (name, "") for name in PARTS if not stands(runner, name, table[name], folder)
    ]
    if unknown := [name for name, _ in asked if name not in PARTS]:
        parser.error(f"{', '.join(unknown)}: no such part; there are {', '.join(PARTS)}")
    if words.list:
        return tell(runner, table, folder)
    end, failed = time.monotonic() + 60 * words.minutes, False
    for name, seed in asked:
        if words.again:
            for each in table[name].steps:
                (runner.work / f"{each.name}.step.json").unlink(missing_ok=True)
        failed |= not run(runner, name, table[name], seed, end, folder)
    return int(failed)


def run(runner: Runner, name: str, part: Part, seed: str, end: float, folder: Path) -> bool:
    """Run a part, or its steps of one seed; False where a step failed or its files cannot be read."""
    for each in wanted(runner, part, seed):
        if runner.record(each) is not None:
            continue
        if (reason := each.missing()) is not None:
            say(f"{name}: not run, {reason}")
            skipped(name, reason, folder)
            return True
        if time.monotonic() + 60 * each.minutes > end:
            say(f"{name}: {each.name} needs about {each.minutes:g} minutes; goes on here next time")
            return True
        say(f"{name}: {each.command}")
        try:
            runner.run(each)
        except subprocess.CalledProcessError as error:
            say(f"{name}: {each.name} failed with exit code {error.returncode}; see {runner.work / each.name}.log")
            return False
    records = [(each.name, runner.record(each)) for each in part.steps]
    if missing := [step_name for step_name, record in records if record is None]:
        say(f"{name}: {len(missing)} of {len(records)} steps are left")
        return True
    try:
        record = assemble(runner, part, {step_name: record for step_name, record in records if record is not None})
    except (LookupError, OSError, TypeError, ValueError) as error:
        say(f"{name}: all steps stand, but their files are not as expected: {error!r}")
        return False
    for target, source in part.pictures.items():
        if folder == FOLDER:
            subprocess.run([sys.executable, "docs/figure.py", runner.work / source, target], cwd=ROOT, check=True)
            record.setdefault("pictures", {})[target] = picture_digest(ROOT / target)
    write(name, record, folder)
    say(f"{name}: {folder / name}.json")
    return True


def wanted(runner: Runner, part: Part, seed: str = "") -> Iterator[Step]:
    """The steps of a part, each behind those that it needs."""
    told: set[str] = set()

    def ordered(each: Step) -> Iterator[Step]:
        for other in runner.needs(each):
            yield from ordered(other)
        if each.name not in told:
            told.add(each.name)
            yield each

    for each in part.steps:
        if not seed or each.seed == int(seed):
            yield from ordered(each)


def assemble(runner: Runner, part: Part, steps: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The JSON of a part."""
    return {
        "title": part.title,
        "commit": ", ".join(dict.fromkeys(record["commit"] for record in steps.values())),
        "date": max(record["date"] for record in steps.values()),
        "configuration": configuration(runner, part),
        "scale": "tiny" if runner.tiny else "full",
        "machine": machine(),
        "figures": part.figures(Work(runner.work)),
        "steps": steps,
    }


def configuration(runner: Runner, part: Part) -> str:
    """Digest of all steps of a part: commands, the code that they run, and what they need."""
    return hashlib.sha256(" ".join(map(runner.digest, part.steps)).encode()).hexdigest()[:16]


def stands(runner: Runner, name: str, part: Part, folder: Path) -> bool:
    """Whether the JSON of a part is there, and of this configuration."""
    file = folder / f"{name}.json"
    return file.is_file() and load(name, folder).get("configuration") == configuration(runner, part)


def skipped(name: str, reason: str, folder: Path) -> None:
    """Record in the JSON of figures from before why they were not run anew."""
    record = load(name, folder) if (folder / f"{name}.json").is_file() else {"title": PARTS[name](SEEDS).title}
    if "configuration" not in record:
        write(name, {**record, "skipped": reason, "figures": record.get("figures", {})}, folder)


def picture_digest(path: Path) -> str:
    """Digest of a picture, by which its JSON knows it."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def tell(runner: Runner, table: dict[str, Part], folder: Path) -> int:
    """Print the parts, what is left of them and how long that takes."""
    for name, part in table.items():
        state = "stands" if stands(runner, name, part, folder) else "to run"
        left = [each for each in wanted(runner, part) if runner.record(each) is None] if state == "to run" else []
        say(f"{name:24} {state:7} {len(left):3} steps, {sum(each.minutes for each in left):4.0f} min  {part.title}")
    return 0


def say(line: str) -> None:
    """Print a line."""
    sys.stdout.write(f"{time.strftime('%H:%M')} {line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
