"""Hooks of pytest: which files of tests take longest, how much of it JAX compiles, and a limit that
no file may pass.

Counted is processor time, of child processes too, and the limit is a part of all of it: neither a
busy machine nor a slow one fails anybody.
"""

import os
from collections import Counter
from typing import Any

import pytest
from benchmarks.compilation import Compilation

SHOWN = 10
BUDGET = 0.15
"""Greatest part of all processor time that one file may take, since one worker runs it as a whole;
the commands of the documents, the largest, take 0.10."""

WHOLE = 100
"""Files in a run from which on parts of it mean something."""

_compilation = Compilation()
_last = {"processor_s": 0.0, "compiling_s": 0.0}
_seconds: dict[str, Counter[str]] = {name: Counter() for name in ("wall_s", *_last)}


def _now() -> dict[str, float]:
    return {"processor_s": sum(os.times()[:4]), "compiling_s": _compilation.seconds()}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    """With what was used since the last report; properties of a report come from the workers to the
    controller."""
    report = yield
    now = _now()
    report.user_properties = [(name, now[name] - _last[name]) for name in now]
    _last.update(now)
    return report


LONGEST_FIRST = (
    "tests/test_documented_runs.py",
    "tests/end_to_end/test_stages.py",
    "tests/rig/test_session.py",
    "tests/tank/calibration/test_calibrate.py",
    "tests/test_documentation.py",
    "tests/learning/test_ppo.py",
    "tests/rig/test_soak.py",
)
"""Files that the others are then dealt out around, so that no worker waits for another at the
end."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, each as a whole; all else stays in its order."""
    rank = {file: place for place, file in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.nodeid.partition("::")[0], len(rank)))


def pytest_sessionstart() -> None:
    """What is imported before the first test is no file's."""
    _last.update(_now())


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add it up by file."""
    file = report.nodeid.partition("::")[0]
    _seconds["wall_s"][file] += report.duration
    for name, seconds in report.user_properties:
        if name in _last:
            _seconds[name][file] += float(seconds)


def beyond_budget() -> list[str]:
    """Files that took more than `BUDGET` of a whole run; the long run has no budget."""
    files = _seconds["processor_s"]
    if os.environ.get("SOFTFIN_LONG") == "1" or len(files) < WHOLE:
        return []
    return [file for file, seconds in files.items() if seconds > BUDGET * files.total()]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The slowest files, where more than one was run."""
    files = _seconds["processor_s"]
    if len(files) < 2:
        return
    shown = int(os.environ.get("SOFTFIN_SLOWEST", SHOWN))
    terminalreporter.section(f"the {min(shown, len(files))} slowest of {len(files)} files")
    lines = [
        (file, *(_seconds[name][file] for name in _seconds)) for file, _ in files.most_common(shown)
    ]
    lines.append(("all", *(sum(column.values()) for column in _seconds.values())))
    for file, wall_s, processor_s, compiling_s in lines:
        line = (
            f"{processor_s:7.1f} s of processor time, {wall_s:7.1f} s, {compiling_s:7.1f} s of "
            f"them compiling  {file}"
        )
        terminalreporter.write_line(line)
    for file in beyond_budget():
        terminalreporter.write_line(
            f"{file}: more than {BUDGET:.0%} of all processor time; make its tests share more"
        )


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A file beyond its budget fails the run."""
    if beyond_budget() and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
