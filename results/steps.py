"""Steps: commands that run in the work folder, each in a process of its own.

A finished step is reused if it has the same command and ran, without uncommitted changes, at HEAD
or at a later commit than the one given by ``--since``; and if no step that it needs has run after
it. Nothing here decides whether a change of the code matters: the record of each step states its
commit, and documents state the age of their figures.
"""

import contextlib
import importlib.util
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from results import ROOT, history
from results.record import machine, versions

RESUMED = {
    **dict.fromkeys(("fit", "calibrate", "train", "reproduce"), ("--resume",)),
    **dict.fromkeys(("studies.ablation", "studies.data_efficiency"), ()),
}
"""Commands and modules that can continue after a stop, and the option for it."""


class Step(NamedTuple):
    """One command and its expected time."""

    name: str
    words: tuple[str, ...]
    minutes: float
    """Expected time on two cores [min]; at most an hour."""
    seed: int | None = None
    tiny: tuple[str, ...] = ()
    """Options added at the tiny scale, which shows only that everything works."""
    extra: str | None = None
    """Module of an optional dependency that the step needs."""
    after: tuple[str, ...] = ()
    """Names of steps that the step needs but its command does not name."""

    @property
    def program(self) -> str:
        """Command of softfin, or the module or script that runs."""
        return self.words[2] if self.words[1] == "-m" else self.words[1]

    @property
    def command(self) -> str:
        """The command as you would type it in the work folder."""
        return shlex.join(self.words)

    def missing(self) -> str | None:
        """Return why this machine cannot run the step; None if it can."""
        if "$SOFTFIN_PUBLISHED" in self.command and "SOFTFIN_PUBLISHED" not in os.environ:
            return "SOFTFIN_PUBLISHED is not set to the folder of the published networks"
        if self.extra is not None and importlib.util.find_spec(self.extra) is None:
            return f"{self.extra} is not installed"
        return None


def step(
    name: str,
    command: str,
    minutes: float,
    seed: int | None = None,
    tiny: str = "",
    extra: str | None = None,
    after: tuple[str, ...] = (),
) -> Step:
    """Make a step from its command line; softfin's commands write to the step's name."""
    words = (*shlex.split(command), *(("--out", name) if command.startswith("softfin") else ()))
    return Step(name, words, minutes, seed, tuple(shlex.split(tiny)), extra, after)


class Runner:
    """Runs steps below one folder."""

    def __init__(
        self,
        work: Path,
        steps: Sequence[Step],
        tiny: bool = False,
        since: str | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Reuse finished steps from HEAD on, or from an earlier commit on.

        Raises ValueError if the history does not have that commit.
        """
        self.work = work
        self.tiny = tiny
        self.steps = {each.name: each for each in steps}
        self._environment = environment or {}
        # Code without a commit has run nothing yet.
        is_reusable = since is not None or not history.has_changes()
        self._reusable_commits = (
            history.list_commits_since(since or "HEAD") if is_reusable else set()
        )
        self._records_of_this_run: dict[str, dict[str, Any]] = {}

    def needs(self, each: Step) -> list[Step]:
        """Return the steps whose results a step needs: most of them are named in its command."""
        named = (word.partition("/")[0] for word in each.words[2:])
        names = {*named, *each.after} - {each.name}
        return [other for name, other in self.steps.items() if name in names]

    def ordered(self, steps: Sequence[Step]) -> Iterator[Step]:
        """Yield steps and all that they need, each once and after those that it needs."""
        names: set[str] = set()

        def visit(each: Step) -> Iterator[Step]:
            for needed in self.needs(each):
                yield from visit(needed)
            if each.name not in names:
                names.add(each.name)
                yield each

        for each in steps:
            yield from visit(each)

    def record(self, each: Step) -> dict[str, Any] | None:
        """Return the record of a finished step that is reused; None if the step has to run."""
        record = self._records_of_this_run.get(each.name) or self._read_reusable(each)
        if record is None:
            return None
        for needed in self.needs(each):
            earlier = self.record(needed)
            if earlier is None or earlier["date"] > record["date"]:
                return None
        return record

    def forget(self, each: Step) -> None:
        """Remove what is known of a step, so that it runs again from its start."""
        self._records_of_this_run.pop(each.name, None)
        self._file(each, "step.json").unlink(missing_ok=True)
        self._file(each, "begun").unlink(missing_ok=True)

    def run(self, each: Step) -> None:
        """Run a step and write its record; raises CalledProcessError if the command fails."""
        commit = history.read_head()
        has_changes = history.has_changes()
        needed = [self.record(other) for other in self.needs(each)]
        start_file = self._file(each, "begun")
        start = json.dumps([each.command, commit, [record and record["date"] for record in needed]])
        # A checkpoint of other code, or of uncommitted code, which may have changed since, is not
        # continued.
        continues = (
            each.program in RESUMED
            and not has_changes
            and start_file.is_file()
            and start_file.read_text() == start
        )
        if not continues:
            out = self.work / each.name
            shutil.rmtree(out, ignore_errors=True)
            shutil.rmtree(out.with_name(f".{out.name}.unfinished"), ignore_errors=True)
        self.work.mkdir(parents=True, exist_ok=True)
        start_file.write_text(start)
        words = _runnable(each.words)
        if self.tiny:
            words += each.tiny
        if continues:
            words += RESUMED[each.program]
        measured = self._run_measured(each, words)
        record = {
            "command": each.command,
            "commit": commit,
            "changed": has_changes,
            "date": datetime.now(UTC).isoformat(sep=" ", timespec="milliseconds"),
            "seed": each.seed,
            "machine": machine(),
            "versions": versions(),
            **measured,
            "resumed": continues,
        }
        self._file(each, "step.json").write_text(json.dumps(record, indent=2))
        self._records_of_this_run[each.name] = record
        start_file.unlink()

    def _run_measured(self, each: Step, words: Sequence[str]) -> dict[str, Any]:
        """Run a command; return its times, its memory and the load of the machine."""
        import_path = os.pathsep.join((str(ROOT / "src"), str(ROOT)))
        # Each step compiles its programs itself, so that times do not depend on what ran before.
        environment = {
            **os.environ,
            **self._environment,
            "SOFTFIN_CACHE": "off",
            "PYTHONPATH": import_path,
        }
        load_before = os.getloadavg()[0]
        busy_before_s = _busy_s()
        start_s = time.perf_counter()
        with contextlib.ExitStack() as files:
            output = files.enter_context(self._file(each, "out").open("w"))
            log = files.enter_context(self._file(each, "log").open("w"))
            process = subprocess.Popen(
                words, cwd=self.work, env=environment, stdout=output, stderr=log
            )
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, each.command)
        wall_s = time.perf_counter() - start_s
        processor_s = usage.ru_utime + usage.ru_stime
        busy_after_s = _busy_s()
        others_cores = None
        if busy_before_s is not None and busy_after_s is not None:
            others_s = busy_after_s - busy_before_s - processor_s
            others_cores = round(max(others_s / wall_s, 0.0), 2)
        return {
            "wall_s": round(wall_s, 1),
            "processor_s": round(processor_s, 1),
            "peak_gib": round(usage.ru_maxrss / 2**20, 2),
            "load_before": round(load_before, 2),
            "load_after": round(os.getloadavg()[0], 2),
            "others_cores": others_cores,
        }

    def _read_reusable(self, each: Step) -> dict[str, Any] | None:
        file = self._file(each, "step.json")
        if not file.is_file():
            return None
        record: dict[str, Any] = json.loads(file.read_text())
        is_reusable = (
            record["command"] == each.command
            and not record["changed"]
            and record["commit"] in self._reusable_commits
        )
        return record if is_reusable else None

    def _file(self, each: Step, kind: str) -> Path:
        return self.work / f"{each.name}.{kind}"


def _runnable(words: Sequence[str]) -> list[str]:
    first, *rest = words
    rest = [
        str(ROOT / word) if (ROOT / word).is_file() else os.path.expandvars(word) for word in rest
    ]
    return [sys.executable, *(("-m", "softfin.cli") if first == "softfin" else ()), *rest]


def _busy_s() -> float | None:
    """Return the processor time that all programs have used [s]; None if the system does not count
    it."""
    try:
        user, nice, system = map(int, Path("/proc/stat").read_text().split()[1:4])
    except OSError:
        return None
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")
