"""Rerun the figures of README and docs: ``python -m results [PART[/SEED] ...]``; without a part,
all of them.

Steps run below runs/results. A run that you stop, or that ``--minutes`` ends, continues at the same
commit: finished steps are reused. ``--since COMMIT`` also reuses those that ran at COMMIT or later.
``PART/3`` runs seed 3 alone; the JSON of a part is written when all of its seeds are finished. Then
``--write`` puts the figures into README and docs.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from results import ROOT, documents, history, quick
from results.parts import PARTS, SEEDS, Part, Work, parts
from results.record import FOLDER, load, write
from results.steps import Runner, Step

WORK = ROOT / "runs" / "results"
QUICK_WORK = ROOT / "runs" / "results-quick"
TINY_SEEDS = (0, 1)


class PartError(Exception):
    """A step failed, or its files are not as expected."""


def main() -> int:
    """Run, list or write; return 1 if something failed."""
    parser = make_parser()
    arguments = parser.parse_args()
    asked = [name.partition("/")[::2] for name in arguments.parts] or [(name, "") for name in PARTS]
    unknown = [name for name, _ in asked if name not in PARTS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: unknown part; there are {', '.join(PARTS)}")
    if arguments.write:
        for path in documents.write():
            say(f"{path.relative_to(ROOT)}: written")
        return 0
    if arguments.list:
        for name, _ in asked:
            sys.stdout.write(f"{name:24} {describe(name, FOLDER)}\n")
        return 0
    try:
        if arguments.quick:
            table = parts((arguments.seed,))
            asked_parts = {name: table[name] for name, _ in asked}
            return quick.run_quick(asked_parts, arguments.seed, QUICK_WORK, FOLDER, say)
        if arguments.tiny is not None:
            return run_parts(
                asked,
                arguments,
                parts(TINY_SEEDS),
                arguments.tiny / "work",
                arguments.tiny / "results",
            )
        return run_parts(asked, arguments, parts(SEEDS), WORK, FOLDER)
    except ValueError as error:
        parser.error(str(error))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART[/SEED]", help=", ".join(PARTS))
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="start no step expected to end later"
    )
    parser.add_argument(
        "--again", action="store_true", help="reuse no finished step of these parts"
    )
    parser.add_argument(
        "--since", metavar="COMMIT", help="reuse finished steps from COMMIT on (default: HEAD)"
    )
    parser.add_argument(
        "--tiny", type=Path, metavar="DIR", help="two seeds of a few updates, below DIR, as a test"
    )
    parser.add_argument(
        "--quick", action="store_true", help="compare one seed of each part with the stated figures"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=quick.SEED,
        help="seed of --quick; one that no table has is a stricter test (default: 10)",
    )
    parser.add_argument(
        "--list", action="store_true", help="print the age of each part and what has changed since"
    )
    parser.add_argument(
        "--write", action="store_true", help="write the figures and their age into README and docs"
    )
    return parser


def run_parts(
    asked: Sequence[tuple[str, str]],
    arguments: argparse.Namespace,
    table: Mapping[str, Part],
    work: Path,
    folder: Path,
) -> int:
    """Run parts one after another and write their JSON; return 1 if one failed, after the others.

    Raises ValueError before anything runs if a part does not have a seed that is asked for.
    """
    for name, seed in asked:
        select_steps(table[name], seed)
    steps = {step.name: step for part in table.values() for step in part.steps}
    runner = Runner(
        work.absolute(), tuple(steps.values()), arguments.tiny is not None, arguments.since
    )
    if arguments.again:
        for name, seed in asked:
            for step in runner.ordered(select_steps(table[name], seed)):
                runner.forget(step)
    end_s = time.monotonic() + 60 * arguments.minutes
    failed = []
    unfinished = []
    for name, seed in asked:
        try:
            reason = run_part(runner, name, table[name], seed, end_s, folder)
        except PartError as error:
            failed.append(f"{name}: failed: {error}")
            say(failed[-1])
        else:
            if reason is not None:
                unfinished.append(f"{name}: not finished: {reason}")
    for line in (*unfinished, *failed):
        say(line)
    return int(bool(failed))


def run_part(
    runner: Runner, name: str, part: Part, seed: str, end_s: float, folder: Path
) -> str | None:
    """Run the steps of a part, or of one seed, and write its JSON; return why it is not finished.

    Raises PartError if a step fails or its files are not as expected.
    """
    for step in runner.ordered(select_steps(part, seed)):
        if runner.record(step) is not None:
            continue
        reason = step.missing()
        if reason is not None:
            return reason
        if time.monotonic() + 60 * step.minutes > end_s:
            return f"{step.name} needs about {step.minutes:g} minutes; run again to continue"
        say(f"{name}: {step.command}")
        try:
            runner.run(step)
        except subprocess.CalledProcessError as error:
            log = runner.work / f"{step.name}.log"
            raise PartError(
                f"{step.name} ended with exit code {error.returncode}; see {log}"
            ) from error
    records: dict[str, dict[str, Any]] = {}
    for step in part.steps:
        record = runner.record(step)
        if record is None:
            return f"{step.name} and perhaps more steps have not run"
        records[step.name] = record
    try:
        figures = part.figures(Work(runner.work))
    except (LookupError, OSError, TypeError, ValueError) as error:
        raise PartError(f"the files of its steps are not as expected: {error!r}") from error
    if folder == FOLDER:
        _draw_pictures(part, runner.work)
    write(name, assemble(part, figures, records, runner.tiny), folder)
    say(f"{name}: {folder / name}.json written")
    return None


def _draw_pictures(part: Part, work: Path) -> None:
    for target, source in part.pictures.items():
        command = [sys.executable, "docs/figure.py", work / source, target]
        subprocess.run(command, cwd=ROOT, check=True)


def select_steps(part: Part, seed: str) -> list[Step]:
    """Return the steps of a part, or those of one seed."""
    if not seed:
        return list(part.steps)
    steps = [step for step in part.steps if str(step.seed) == seed]
    if not steps:
        seeds = sorted({step.seed for step in part.steps if step.seed is not None})
        raise ValueError(
            f"{part.title}: no step of seed {seed}; the seeds are "
            f"{', '.join(map(str, seeds)) or 'none'}"
        )
    return steps


def assemble(
    part: Part,
    figures: Mapping[str, dict[str, Any]],
    records: Mapping[str, dict[str, Any]],
    tiny: bool,
) -> dict[str, Any]:
    """Return the JSON of a part; machine and versions are those of the last step, and each step has
    its own."""
    last = max(records.values(), key=lambda record: record["date"])
    seeds = {seed for figure in figures.values() for seed in figure["seeds"]}
    return {
        "title": part.title,
        "commits": list(dict.fromkeys(record["commit"] for record in records.values())),
        "date": last["date"][: len("2026-11-24")],
        "seeds": sorted(seeds),
        "scale": "tiny" if tiny else "full",
        "machine": last["machine"],
        "versions": last["versions"],
        "figures": figures,
        "steps": records,
    }


def describe(name: str, folder: Path) -> str:
    """Return the date, commits and age of a part and what has changed since, in one line."""
    if not (folder / f"{name}.json").is_file():
        return f"no {name}.json; run `python -m results {name}`"
    record = load(name, folder)
    text = f"{record['date']}  {', '.join(record['commits'])}"
    if any(step["changed"] for step in record["steps"].values()):
        text += " with uncommitted changes"
    oldest = history.find_oldest(record["commits"])
    if oldest is None:
        unknown = [commit for commit in record["commits"] if not history.has_commit(commit)]
        return (
            f"{text}; age unknown: this clone does not have {', '.join(unknown)}; run `git "
            "fetch --unshallow`"
        )
    commit, age = oldest
    changes = history.list_changes_since(commit)
    return f"{text}; {history.format_age(age)}; changed since: {', '.join(changes) or 'nothing'}"


def say(line: str) -> None:
    """Print a line with the time."""
    sys.stdout.write(f"{time.strftime('%H:%M')} {line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
