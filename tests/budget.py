"""Hooks of pytest: the longest files of tests come first, and which ones took longest is told.

Counted is processor time, of child processes too, so that a busy machine makes nobody look slow.
"""

import os
from collections import Counter
from typing import Any

import pytest

SHOWN = 10

LONGEST_FIRST = (
    "tests/test_documented_runs.py",
    "tests/cli/test_robot.py",
    "tests/end_to_end/test_stages.py",
    "tests/tank/test_tank.py",
    "tests/rig/test_commissioning.py",
    "tests/tank/calibration/test_calibrate.py",
    "tests/learning/test_ppo.py",
    "tests/test_mutants.py",
)
"""Files that the others are then dealt out around, so that no worker waits for another at the
end."""

_last_s = 0.0
_seconds: Counter[str] = Counter()


def pytest_sessionstart() -> None:
    """What is imported before the first test is no file's."""
    global _last_s
    _last_s = sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, each as a whole; all else stays in its order."""
    rank = {file: place for place, file in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.nodeid.partition("::")[0], len(rank)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    """With what was used since the last report; properties of a report come from the workers to the
    controller."""
    global _last_s
    report = yield
    before_s, _last_s = _last_s, sum(os.times()[:4])
    report.user_properties = [("processor_s", _last_s - before_s)]
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add it up by file."""
    seconds = dict(report.user_properties).get("processor_s", 0.0)
    _seconds[report.nodeid.partition("::")[0]] += float(seconds)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The slowest files, where more than one was run."""
    if len(_seconds) < 2:
        return
    shown = int(os.environ.get("SOFTFIN_SLOWEST", SHOWN))
    terminalreporter.section(f"the {min(shown, len(_seconds))} slowest of {len(_seconds)} files")
    for file, seconds in [*_seconds.most_common(shown), ("all", _seconds.total())]:
        terminalreporter.write_line(f"{seconds:7.1f} s of processor time  {file}")
