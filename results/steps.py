"""Steps: commands that run in the work folder, each in a process of its own, and are not run again while they stand.

A step stands while its digest does: over its words, the code that it runs (comments and docstrings left out) and the
digests of the steps whose results it reads. A stopped step goes on where softfin's own ``--resume`` can.
"""

import ast
import hashlib
import importlib.util
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from results import ROOT

PACKAGE = ROOT / "src" / "softfin"

BELOW = ("core", "storage")
ROOMS = {
    "import-keras": ("surrogate",),
    "collect": ("data", "tank"),
    "fit": ("data", "surrogate"),
    "compare": ("surrogate", "tank"),
    "calibrate": ("surrogate", "tank"),
    "map": ("gaits", "surrogate"),
    "train": ("control", "gaits", "learning", "surrogate", "task"),
    "evaluate": ("control", "evaluation", "gaits", "surrogate", "tank", "task"),
    "baselines": ("evaluation", "gaits", "surrogate", "tank", "task"),
    "reproduce": ("control", "data", "evaluation", "gaits", "learning", "stages", "surrogate", "tank", "task"),
    "docs/ablation.py": ("data", "surrogate", "tank"),
    "docs/data_efficiency.py": ("data", "surrogate", "tank"),
    "docs/faster_reaction.py": ("control", "evaluation", "gaits", "learning", "surrogate", "tank", "task"),
    "robot": ("gaits", "learning", "robot", "tank"),
    "as-test": (),
    "tank-r2": ("surrogate", "tank"),
    "efficiency": (),
}
"""Rooms of softfin whose code decides what a command gives, beside `BELOW`; of any other command all of softfin."""

RESUMED = {
    **dict.fromkeys(("fit", "train", "calibrate", "reproduce"), ("--resume",)),
    **dict.fromkeys(("docs/ablation.py", "docs/data_efficiency.py"), ()),
}
"""Commands that go on where they were stopped, and the option that tells them to."""


class Step(NamedTuple):
    """One command and what it is expected to take."""

    name: str
    words: tuple[str, ...]
    minutes: float
    """Expected on two cores; at most an hour."""
    seed: int | None = None
    tiny: tuple[str, ...] = ()
    """Words added at the tiny scale, which shows only that everything works."""
    extra: str | None = None
    """Module of an optional dependency that it needs."""

    @property
    def command(self) -> str:
        """The command as one would type it in the work folder."""
        return shlex.join(self.words)

    def missing(self) -> str | None:
        """Why this machine cannot run it; None where it can."""
        if "$SOFTFIN_PUBLISHED" in self.command and "SOFTFIN_PUBLISHED" not in os.environ:
            return "SOFTFIN_PUBLISHED does not name the folder of the authors' published nets"
        if self.extra is not None and importlib.util.find_spec(self.extra) is None:
            return f"{self.extra} is not installed"
        return None


def step(
    name: str, command: str, minutes: float, seed: int | None = None, tiny: str = "", extra: str | None = None
) -> Step:
    """A step from its command line; softfin's commands write to the step's name."""
    words = (*shlex.split(command), *(("--out", name) if command.startswith("softfin") else ()))
    return Step(name, words, minutes, seed, tuple(shlex.split(tiny)), extra)


class Runner:
    """Runs steps below one folder."""

    def __init__(self, work: Path, steps: Sequence[Step], tiny: bool = False) -> None:
        self.work, self.tiny = work, tiny
        self.steps = {each.name: each for each in steps}
        self._digests: dict[str, str] = {}

    def needs(self, each: Step) -> list[Step]:
        """The steps whose results its words name."""
        names = {word.partition("/")[0] for word in each.words[2:]} - {each.name}
        return [other for name, other in self.steps.items() if name in names]

    def digest(self, each: Step) -> str:
        """What decides whether it has to be run again."""
        if each.name not in self._digests:
            before = [self.digest(other) for other in self.needs(each)]
            self._digests[each.name] = _hash(each.words, each.tiny if self.tiny else (), code(each.words), before)
        return self._digests[each.name]

    def record(self, each: Step) -> dict[str, Any] | None:
        """The account of a step that stands; None where it has to be run."""
        file = self.work / f"{each.name}.step.json"
        record: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
        return record if record.get("digest") == self.digest(each) else None

    def run(self, each: Step) -> None:
        """Run a step, and write its account; raises CalledProcessError where it fails."""
        out, begun, digest = self.work / each.name, self.work / f"{each.name}.begun", self.digest(each)
        goes_on = each.words[1] in RESUMED and begun.is_file() and begun.read_text() == digest
        for place in () if goes_on else (out, out.with_name(f".{out.name}.unfinished")):
            shutil.rmtree(place, ignore_errors=True)
        self.work.mkdir(parents=True, exist_ok=True)
        begun.write_text(digest)
        words = [
            *_runnable(each.words),
            *(each.tiny if self.tiny else ()),
            *(RESUMED[each.words[1]] if goes_on else ()),
        ]
        # Every step compiles its programs anew, so that times do not depend on what ran before.
        paths = os.pathsep.join((str(PACKAGE.parent), str(ROOT)))
        environment = os.environ | {"SOFTFIN_CACHE": "off", "PYTHONPATH": paths}
        version, load, busy, start = commit(), os.getloadavg()[0], _busy_s(), time.perf_counter()
        with (self.work / f"{each.name}.out").open("w") as told, (self.work / f"{each.name}.log").open("w") as log:
            process = subprocess.Popen(words, cwd=self.work, env=environment, stdout=told, stderr=log)
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, each.command)
        wall, cpu = time.perf_counter() - start, usage.ru_utime + usage.ru_stime
        now = _busy_s()
        record = {
            "command": each.command, "digest": digest, **version, "date": time.strftime("%Y-%m-%d"),
            "wall_s": round(wall, 1), "processor_s": round(cpu, 1), "peak_gib": round(usage.ru_maxrss / 2**20, 2),
            "load_before": round(load, 2), "load_after": round(os.getloadavg()[0], 2),
            "others_cores": None if busy is None or now is None else round(max((now - busy - cpu) / wall, 0.0), 2),
            "resumed": goes_on,
        }  # fmt: skip
        (self.work / f"{each.name}.step.json").write_text(json.dumps(record, indent=2))
        begun.unlink()


def _runnable(words: Sequence[str]) -> list[str]:
    first, *rest = words
    rest = [str(ROOT / word) if (ROOT / word).is_file() else os.path.expandvars(word) for word in rest]
    return [sys.executable, *(("-m", "softfin.cli") if first == "softfin" else ()), *rest]


def code(words: Sequence[str]) -> str:
    """Digest of the code that a command runs, without comments and docstrings."""
    name = words[3] if words[1:3] == ("-m", "results.scripts") else words[1]
    places = [PACKAGE / room for room in (*BELOW, *ROOMS[name])] if name in ROOMS else [PACKAGE]
    places += [ROOT / word for word in words if (ROOT / word).is_file()]
    if words[1:3] == ("-m", "benchmarks"):
        places += sorted({ROOT / "benchmarks" / "__main__.py", *_with_imports(ROOT / "benchmarks" / f"{words[3]}.py")})
    elif words[1] == "-m":
        places.append((ROOT / words[2].replace(".", "/")).with_suffix(".py"))
    # The paper's nets and the authors' need nothing of the streaming ones.
    streaming = words[0] != "softfin" or words[1] == "reproduce" or any("streaming" in word for word in words)
    left_out = () if streaming else (PACKAGE / "surrogate" / "streaming",)
    # Of all commands, those of robots and of the page alone run their code, the page's with its scripts.
    left_out += tuple(
        PACKAGE / room for word, room in (("robot", "robot"), ("explore", "explorer")) if word not in words
    )
    places += sorted((PACKAGE / "explorer").glob("*.j*")) if "explore" in words else []
    return _hash(*(_code_of(place, left_out) for place in places))


def _with_imports(file: Path) -> set[Path]:
    """A benchmark and what it imports of the others, which import nothing in circles."""
    nodes = ast.walk(ast.parse(file.read_text()))
    modules = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    names = [module.partition(".")[2] for module in modules if module.startswith("benchmarks.")]
    return {file}.union(*(_with_imports(file.with_name(f"{name}.py")) for name in names))


@cache
def _code_of(place: Path, left_out: tuple[Path, ...]) -> list[str]:
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [_bare(file) for file in files if not any(folder in file.parents for folder in left_out)]


def _bare(file: Path) -> str:
    if file.suffix != ".py":
        return file.read_text()
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [line for line in body if not _is_text(line)]  # type: ignore[attr-defined]
    return ast.unparse(tree)


def _is_text(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


def _hash(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def commit() -> dict[str, Any]:
    """The commit, and whether the code differs from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    return {"commit": git("rev-parse", "--short=7", "HEAD"), "changed": bool(git("status", "--porcelain", "src"))}


def _busy_s() -> float | None:
    """Processor time that the whole machine has spent [s]; None where nobody counts it."""
    try:
        user, nice, system = map(int, Path("/proc/stat").read_text().split()[1:4])
    except OSError:
        return None
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")
