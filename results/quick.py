"""Rerun one seed of every part at full scale and compare its figures with the stated ones: ``make
results-quick``.

Steps run in a folder of their own, two at a time on one thread each: their times are not judged. A
run that was stopped continues at the same commit; after a complete one the next run starts afresh.
"""

import json
import math
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from results import documents, history
from results.comparison import Comparison, Verdict, allowed_outside, compare_figures
from results.parts import Part, Work
from results.record import QUIET_CORES, load, machine, shown, versions
from results.steps import Runner, Step

SEED = 10
"""Seed that a run repeats if no other is asked for; the stated figures contain it."""

SIMULTANEOUS_STEPS = 2

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}
"""Variables that keep NumPy and XLA to one thread per process."""

REPORT = "report.json"

Say = Callable[[str], None]


class PartResult(NamedTuple):
    """What became of one part."""

    reason: str | None
    """Why it has no figures; None if it has been compared."""
    is_failure: bool = False
    """Whether this fails the run; leaving a part out does not."""
    comparisons: Mapping[str, Comparison] = {}

    def count(self, verdict: Verdict) -> int:
        """Return the number of figures with a verdict."""
        return sum(comparison.verdict == verdict for comparison in self.comparisons.values())


def find_reason_to_leave_out(name: str) -> str | None:
    """Return why a quick run leaves a part out; None if it runs the part."""
    if name.startswith("bench-"):
        return "measures times alone, which other steps disturb and which are not judged"
    return None


def estimate_minutes(table: Mapping[str, Part], folder: Path) -> float:
    """Return the expected time of a run [min], from the times of the stated figures."""
    last_s: dict[str, float] = {}
    for name in table:
        if (folder / f"{name}.json").is_file():
            for step_name, record in load(name, folder)["steps"].items():
                # One thread takes the processor time of several. Wall time counts only if nothing
                # else ran.
                is_quiet = (record["others_cores"] or 0.0) <= QUIET_CORES
                wall_s = record["wall_s"] if is_quiet else 0.0
                last_s[_drop_seed(step_name)] = max(wall_s, record["processor_s"])
    steps = {step.name: step for part in table.values() for step in part.steps}
    total_s = sum(last_s.get(_drop_seed(name), 60 * step.minutes) for name, step in steps.items())
    return total_s / 60 / SIMULTANEOUS_STEPS


def _drop_seed(step_name: str) -> str:
    """Return the name that a step has in common with those of other seeds."""
    stem, _, seed = step_name.rpartition("-")
    return stem if seed.isdecimal() else step_name


def run_quick(table: Mapping[str, Part], seed: int, work: Path, folder: Path, say: Say) -> int:
    """Compare one seed of parts with the JSON files in `folder`; write a report; return 1 if
    figures do not hold."""
    report_file = work / REPORT
    if report_file.is_file():
        shutil.rmtree(work)
    parts_to_run = {
        name: part for name, part in table.items() if explain_missing(name, part) is None
    }
    say(
        f"quick: {len(parts_to_run)} parts, about {estimate_minutes(parts_to_run, folder):.0f} "
        "minutes on two cores"
    )
    steps = {step.name: step for part in parts_to_run.values() for step in part.steps}
    runner = Runner(work, tuple(steps.values()), environment=ONE_THREAD)
    start_s = time.perf_counter()
    failures = run_steps(runner, say)
    results: dict[str, PartResult] = {}
    for name, part in table.items():
        reason = explain_missing(name, part)
        results[name] = (
            compare_part(name, part, work, folder, failures)
            if reason is None
            else PartResult(reason)
        )
    far_outside = find_far_outside(results)
    verdict = describe_verdict(results, far_outside)
    report = make_report(results, seed, verdict, (time.perf_counter() - start_s) / 60)
    work.mkdir(parents=True, exist_ok=True)
    report_file.write_text(json.dumps(report, indent=1) + "\n")
    for line in (*format_table(results), *format_figures(results, folder), verdict):
        say(line)
    return int(not has_passed(results, far_outside))


def explain_missing(name: str, part: Part) -> str | None:
    """Return why a part does not run: a quick run leaves it out, or this machine cannot run it."""
    reasons = [find_reason_to_leave_out(name), *(step.missing() for step in part.steps)]
    return next((reason for reason in reasons if reason is not None), None)


def run_steps(runner: Runner, say: Say) -> dict[str, str]:
    """Run all steps of a runner, some at a time and each after those it needs; return why steps
    failed, by name."""
    waiting = [
        step for step in runner.ordered(tuple(runner.steps.values())) if runner.record(step) is None
    ]
    running: dict[Future[None], Step] = {}
    failures: dict[str, str] = {}
    with ThreadPoolExecutor(SIMULTANEOUS_STEPS) as pool:
        while waiting or running:
            for step in tuple(waiting):
                failed = [needed.name for needed in runner.needs(step) if needed.name in failures]
                if failed:
                    failures[step.name] = f"{step.name} needs {failed[0]}, which failed"
                    waiting.remove(step)
                elif len(running) < SIMULTANEOUS_STEPS and is_ready(
                    step, runner, waiting, running.values()
                ):
                    say(f"{step.name}: {step.command}")
                    waiting.remove(step)
                    running[pool.submit(runner.run, step)] = step
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                step = running.pop(future)
                failure = future.exception()
                if isinstance(failure, subprocess.CalledProcessError):
                    log = runner.work / f"{step.name}.log"
                    failures[step.name] = (
                        f"{step.name} failed with exit code {failure.returncode}; see {log}"
                    )
                elif failure is not None:
                    failures[step.name] = f"{step.name} failed: {failure!r}"
                if failure is not None:
                    say(failures[step.name])
    return failures


def is_ready(step: Step, runner: Runner, waiting: Iterable[Step], running: Iterable[Step]) -> bool:
    """Return whether all steps that a step needs are finished."""
    unfinished = {each.name for each in (*waiting, *running)}
    return all(needed.name not in unfinished for needed in runner.needs(step))


def compare_part(
    name: str, part: Part, work: Path, folder: Path, failures: Mapping[str, str]
) -> PartResult:
    """Compare the figures of one seed of a part with its JSON."""
    for step in part.steps:
        if step.name in failures:
            return PartResult(failures[step.name], is_failure=True)
    if not (folder / f"{name}.json").is_file():
        reason = f"no results/{name}.json to compare with; run `python -m results {name}`"
        return PartResult(reason, is_failure=True)
    try:
        measured = part.figures(Work(work))
        comparisons = compare_stated(name, folder, measured)
    except (LookupError, OSError, TypeError, ValueError) as error:
        return PartResult(f"its files are not as expected: {error!r}", is_failure=True)
    return PartResult(None, comparisons=comparisons)


def compare_stated(
    name: str, folder: Path, measured: Mapping[str, Mapping[str, Any]]
) -> dict[str, Comparison]:
    """Compare measured figures with the JSON of a part."""
    digits = {
        figure: digit
        for (owner, figure), digit in documents.printed_digits().items()
        if owner == name
    }
    default_digit = documents.last_digit(documents.DEFAULT_FORM)
    return compare_figures(load(name, folder)["figures"], measured, digits, default_digit)


def find_far_outside(results: Mapping[str, PartResult]) -> list[str]:
    """Return the figures that are outside and have changed by more than a factor of three."""
    return [
        f"{name}.{figure}"
        for name, result in results.items()
        for figure, comparison in result.comparisons.items()
        if comparison.is_far
    ]


def count_all(results: Mapping[str, PartResult], verdict: Verdict) -> int:
    """Return the number of figures of all parts with a verdict."""
    return sum(result.count(verdict) for result in results.values())


def has_passed(results: Mapping[str, PartResult], far_outside: Sequence[str]) -> bool:
    """Return whether no part failed, no figure is missing or far outside, and no more are outside
    than by chance."""
    if any(result.is_failure for result in results.values()) or far_outside:
        return False
    inside = count_all(results, "inside")
    outside = count_all(results, "outside")
    return (
        inside > 0
        and count_all(results, "missing") == 0
        and outside <= allowed_outside(inside + outside)
    )


def describe_verdict(results: Mapping[str, PartResult], far_outside: Sequence[str]) -> str:
    """Return the last line of a run, which starts with PASS or FAIL."""
    inside = count_all(results, "inside")
    outside = count_all(results, "outside")
    text = (
        f"{'PASS' if has_passed(results, far_outside) else 'FAIL'}: {inside} figures inside their "
        f"intervals, {outside} outside (by chance at most {allowed_outside(inside + outside)}), "
        f"{count_all(results, 'missing')} missing"
    )
    if far_outside:
        text += f"; far outside: {', '.join(far_outside)}"
    failed = [name for name, result in results.items() if result.is_failure]
    if failed:
        text += f"; failed: {', '.join(failed)}"
    not_run = [
        name
        for name, result in results.items()
        if result.reason is not None and not result.is_failure
    ]
    if not_run:
        text += f"; not run: {', '.join(not_run)}"
    return text


def format_table(results: Mapping[str, PartResult]) -> list[str]:
    """Return a line for each part."""
    lines = [f"{'part':24} {'inside':>7} {'outside':>7} {'missing':>7} {'not judged':>10}"]
    for name, result in results.items():
        if result.reason is not None:
            state = "FAILED" if result.is_failure else "not run"
            lines.append(f"{name:24} {state}: {result.reason}")
        else:
            inside, outside, missing = (
                result.count(verdict) for verdict in ("inside", "outside", "missing")
            )
            not_judged = result.count("not judged")
            lines.append(f"{name:24} {inside:7} {outside:7} {missing:7} {not_judged:10}")
    return lines


def format_figures(results: Mapping[str, PartResult], folder: Path) -> list[str]:
    """Return a line for each figure that is not inside: outside, missing, or not judged (times,
    memory and rates)."""
    lines = []
    for name, result in results.items():
        if result.reason is not None:
            continue
        stated = load(name, folder)["figures"]
        for figure, comparison in result.comparisons.items():
            if comparison.verdict == "inside":
                continue
            values = " and ".join(format_value(value) for value in comparison.values) or "-"
            unit = f" {comparison.unit}" if comparison.unit else ""
            line = f"{comparison.verdict}: {name}.{figure} = {values}{unit}"
            line += (
                f"; stated {shown(stated[figure], '.4g')}" if figure in stated else "; not stated"
            )
            if comparison.verdict == "outside":
                line += (
                    "; expected "
                    f"{' / '.join(format_interval(*each) for each in comparison.intervals)}"
                )
            lines.append(line)
    return sorted(lines, key=lambda line: line.startswith("not judged"))


def format_value(value: Any) -> str:
    """Return a number, or x / y."""
    if value is None:
        return "never"
    return (
        f"{value:.4g}"
        if isinstance(value, int | float)
        else " / ".join(f"{axis:.4g}" for axis in value)
    )


def format_interval(low: float, high: float) -> str:
    """Return an interval, or the maximum of a worst case."""
    return f"at most {high:.4g}" if math.isinf(low) else f"{low:.4g} to {high:.4g}"


def make_report(
    results: Mapping[str, PartResult], seed: int, verdict: str, minutes: float
) -> dict[str, Any]:
    """Return the JSON of a run."""
    parts = {}
    for name, result in results.items():
        figures = {}
        for figure, comparison in result.comparisons.items():
            intervals = [
                [None if math.isinf(end) else end for end in interval]
                for interval in comparison.intervals
            ]
            figures[figure] = {**comparison._asdict(), "intervals": intervals}
        parts[name] = {"reason": result.reason, "failed": result.is_failure, "figures": figures}
    return {
        "verdict": verdict,
        "commit": history.read_head(),
        "changed": history.has_changes(),
        "date": time.strftime("%Y-%m-%d"),
        "minutes": round(minutes, 1),
        "seed": seed,
        "machine": {**machine(), "load": os.getloadavg()},
        "versions": versions(),
        "parts": parts,
    }
