"""No limit on time fails a correct program on a slow or busy computer: limits only end what
hangs."""

import ast
import re
import tomllib
from collections.abc import Iterator

import hypothesis
import pytest

from tests.documents import ROOT
from tests.patience import HANG_S

SCRIPTS = [
    path
    for folder in ("tests", "docs", "examples", "studies")
    for path in sorted((ROOT / folder).rglob("*.py"))
]

WAITS = (
    "wait",
    "join",
    "communicate",
    "settimeout",
    "create_connection",
    "urlopen",
    "HTTPConnection",
    "run",
    "Popen",
)
"""Names of calls that wait in real time for as long as their number or their timeout says."""

SIMULATED = (
    "tests/rig/conformance.py",
    "tests/rig/devices/epos2/test_drive.py",
    "tests/rig/devices/epos2/test_own_stop.py",
    "tests/rig/devices/epos2/test_several_fins.py",
    "tests/rig/ros2/test_plant.py",
    "tests/rig/test_simulated_clock.py",
)
"""Files in which these waits are in simulated time, in which nothing is slow."""


def number_of(node: ast.expr | None) -> float | None:
    """The value of a number that is written out."""
    is_number = (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and node.value is not True
    )
    return float(node.value) if is_number else None


def limits_of(text: str) -> Iterator[tuple[int, str]]:
    """The limits on real time in a script: numbers in calls that wait, in deadlines, in comparisons
    with a duration."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            name = (
                node.func.attr
                if isinstance(node.func, ast.Attribute)
                else getattr(node.func, "id", "")
            )
            by_keyword = [word.value for word in node.keywords if word.arg == "timeout"]
            by_place = node.args[:1] if name in ("wait", "join", "settimeout") else []
            if name in WAITS and any(
                number_of(value) is not None for value in (*by_keyword, *by_place)
            ):
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.BinOp | ast.Compare):
            parts = (
                [node.left, node.right]
                if isinstance(node, ast.BinOp)
                else [node.left, *node.comparators]
            )
            is_sum = isinstance(node, ast.Compare) or isinstance(node.op, ast.Add)
            has_clock = any(
                re.search(r"(monotonic|perf_counter)\(\)", ast.unparse(part)) for part in parts
            )
            if is_sum and has_clock and any(number_of(part) is not None for part in parts):
                yield node.lineno, ast.unparse(node)


@pytest.mark.parametrize(
    "line",
    [
        "thread.join(5)",
        "process.wait(timeout=30)",
        "subprocess.run(words, timeout=60, check=True)",
        "deadline = time.monotonic() + 20",
        "assert time.perf_counter() - start < 10",
    ],
)
def test_a_limit_that_is_written_out_is_found(line):
    assert [number for number, _ in limits_of(line)] == [1]


@pytest.mark.parametrize(
    "line", ["', '.join(names)", "thread.join(HANG_S)", "age = time.monotonic() - 3"]
)
def test_what_is_no_limit_is_none(line):
    assert list(limits_of(line)) == []


def test_tests_documents_and_examples_wait_for_as_long_as_patience_says():
    found = [
        f"{path.relative_to(ROOT)}:{line} {text}"
        for path in SCRIPTS
        if path.relative_to(ROOT).as_posix() not in (*SIMULATED, "tests/test_time_limits.py")
        for line, text in limits_of(path.read_text())
    ]
    assert found == []


def test_cells_of_the_site_are_given_as_long_as_tests():
    (limit,) = re.findall(
        r"^nb_execution_timeout = (.*)$", (ROOT / "docs/conf.py").read_text(), re.MULTILINE
    )
    assert float(limit) >= HANG_S


def test_a_test_that_hangs_is_shown_before_its_wait_is_over():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert 300 <= options["faulthandler_timeout"] < HANG_S


def test_examples_of_hypothesis_may_take_as_long_as_they_do():
    assert hypothesis.settings().deadline is None
    assert hypothesis.HealthCheck.too_slow in hypothesis.settings().suppress_health_check
