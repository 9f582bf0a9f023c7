"""The tool that tests tests, on a module of three lines with a weak and a strong test."""

import contextlib
import io
import json
import textwrap
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest
from tools import mutants

LIMIT = """
def is_within(value: float, low: float, high: float) -> bool:
    return low <= value <= high
"""

WEAK = """
from tiny.limit import is_within

def test_inside_and_outside():
    assert is_within(1, 0, 2)
    assert not is_within(3, 0, 2)
    assert not is_within(-1, 0, 2)
"""

STRONG = (
    WEAK
    + """
def test_the_ends_are_inside():
    assert is_within(0, 0, 2)
    assert is_within(2, 0, 2)
"""
)

CONFIGURATION = """
package = "src/tiny"
wider = ["tests/wider"]

[tests]
"limit.py" = ["tests/test_limit.py"]
"""

EXPLANATION = """
[[explained]]
module = "limit.py"
source = "return low <= value <= high"
replacement = "return {replacement}"
reason = "equality of two floats"
"""


def project(
    root: Path, tests: str = WEAK, wider: str = WEAK, explained: str = "", module: str = LIMIT
) -> Path:
    files = {
        "src/tiny/limit.py": module,
        "tests/test_limit.py": tests,
        "tests/wider/test_wider.py": wider,
        "tools/mutants.toml": CONFIGURATION + explained,
    }
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)
    return root


def mutated_lines(source: str) -> set[str]:
    return {
        mutation.after for mutation in mutants.find_mutations("module.py", textwrap.dedent(source))
    }


@pytest.mark.parametrize(
    ("source", "lines"),
    [
        ("near = a < b", {"near = a <= b", "near = a >= b"}),
        ("same = (a) is not (b)", {"same = (a) is (b)"}),
        ("rest = a - b", {"rest = a + b"}),
        ("either = a or b", {"either = a and b"}),
        ("free = not full", {"free = full"}),
        ("half = 0.5", {"half = (0.5 + 1)", "half = (0.5 * 2)", "half = (-0.5)"}),
        ("first = 0", {"first = (0 + 1)"}),
        ("fresh = True", {"fresh = False"}),
        (
            "worst = max(loads)",
            {
                "worst = min(loads)",
            },
        ),
        ("force = wrench[:three]", {"force = wrench[:three + 1]", "force = wrench[:three - 1]"}),
        ("motor.stop()", {"pass"}),
        ("motor.state = off", {"pass"}),
        ("turned = cross(a, b)", {"turned = cross(b, a)"}),
        ("if hot: stop = 'now'", {"if (not (hot)): stop = 'now'"}),
        ("x = 'µ'; late = a > b", {"x = 'µ'; late = a >= b", "x = 'µ'; late = a <= b"}),
    ],
)
def test_each_operator_makes_its_mutants(source: str, lines: set[str]) -> None:
    assert mutated_lines(source) == lines


def test_annotations_and_texts_are_not_mutated() -> None:
    source = '''
    """At most 3 N."""

    def tell(force: "Float[Array, '3']" = None, other: int | None = None) -> tuple[int, int]:
        text = f"{force * 2:.1f} N" + " at 3 V"
    '''
    assert mutated_lines(source) == set()


def test_a_statement_of_several_lines_is_named_whole() -> None:
    (mutation,) = mutants.find_mutations(
        "module.py", "for motor in motors:\n    motor.stop(\n        now,\n    )\n"
    )
    assert (mutation.line, mutation.before, mutation.after) == (
        2,
        "motor.stop(\n        now,\n    )",
        "pass",
    )


def test_the_draw_is_even_over_modules_and_the_same_for_a_seed(tmp_path: Path) -> None:
    root = project(tmp_path)
    for name in ("one.py", "two.py", "three.py"):
        (root / "src/tiny" / name).write_text("low = [1, 2, 3, 4, 5, 6]\nhigh = a < b\n")
    drawing = mutants.Project.load(root)
    drawn = mutants.draw(drawing, ["one.py", "two.py", "three.py"], 11, seed=5)
    assert Counter(mutation.module for mutation in drawn) == {
        "one.py": 4,
        "two.py": 4,
        "three.py": 3,
    }
    assert len(set(drawn)) == 11
    assert mutants.draw(drawing, ["one.py", "two.py", "three.py"], 11, seed=5) == drawn
    assert mutants.draw(drawing, ["one.py", "two.py", "three.py"], 11, seed=6) != drawn


def run(root: Path) -> tuple[int, str]:
    """Run all mutants, five at most; return the exit code and what is printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = mutants.main(["5"], root)
    return code, printed.getvalue()


def counts(printed: str) -> list[int]:
    """Killed, timeout, explained and survived of all modules."""
    (line,) = [line for line in printed.splitlines() if line.startswith("all ")]
    return [int(number) for number in line.split()[1:]]


class Weak(NamedTuple):
    """A project with weak tests, and how its run ended."""

    root: Path
    code: int
    printed: str


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> Weak:
    root = project(tmp_path_factory.mktemp("weak"))
    return Weak(root, *run(root))


@pytest.mark.slow
def test_mutants_survive_a_weak_test(weak: Weak) -> None:
    assert weak.code == 1
    assert counts(weak.printed) == [3, 0, 0, 2]
    assert "`return low <= value <= high` -> `return low < value <= high`" in weak.printed
    assert (weak.root / "src/tiny/limit.py").read_text() == LIMIT


@pytest.mark.slow
def test_no_mutant_survives_strong_tests_of_its_module_or_wider_ones(tmp_path: Path) -> None:
    code, printed = run(project(tmp_path, wider=STRONG))
    assert code == 0
    assert counts(printed) == [5, 0, 0, 0]


@pytest.mark.slow
def test_a_survivor_needs_an_explanation_and_an_explanation_its_mutant(weak: Weak) -> None:
    low, high, unknown = (
        EXPLANATION.format(replacement=replacement)
        for replacement in ("low < value <= high", "low <= value < high", "low < value < high")
    )
    code, printed = run(project(weak.root, explained=low + high))
    assert code == 0
    assert counts(printed) == [3, 0, 2, 0]
    assert "equality of two floats" in printed
    code, printed = run(project(weak.root, explained=low + high + unknown))
    assert code == 1
    assert "-> `return low < value < high`: no such mutant; remove the explanation" in printed


@pytest.mark.slow
def test_an_interrupted_run_does_only_what_is_left(
    weak: Weak, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = project(weak.root)
    (journal,) = (root / "build/mutants").iterdir()
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(lines[:-3]))
    assert run(root) == weak[1:]
    names = [json.loads(line)["run"] for line in journal.read_text().splitlines()]
    assert Counter(names) == Counter(json.loads(line)["run"] for line in lines)

    def fail(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(mutants, "_run_tests", fail)
    assert run(root) == weak[1:]


@pytest.mark.slow
def test_a_mutant_that_never_ends_is_killed_by_its_time_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mutants, "SPARE_S", 1.0)
    countdown = (
        "def remaining(number, step):\n    while number:\n        number -= step\n    "
        "return number\n"
    )
    test = (
        "from tiny.limit import remaining\n\ndef test_it_ends():\n    assert remaining(4, 2) == 0\n"
    )
    code, printed = run(project(tmp_path, tests=test, module=countdown))
    assert code == 0
    assert counts(printed) == [2, 1, 0, 0]
    assert "s: limit.py:3 arithmetic `number -= step` -> `number += step`" in printed


def test_tests_that_fail_without_a_mutant_are_an_error(tmp_path: Path) -> None:
    root = project(tmp_path, tests=WEAK.replace("not ", ""))
    with pytest.raises(
        SystemExit,
        match=r"test_limit\.py: failed without a mutant .*test_inside.*repair them first",
    ):
        mutants.main(["1"], root)


def test_a_module_that_is_not_listed_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        mutants.main(["1", "--modules", "lmit.py"], project(tmp_path))
    assert (
        "lmit.py: not in tools/mutants.toml; add them with their tests" in capsys.readouterr().err
    )


def test_the_modules_and_tests_of_the_configuration_exist() -> None:
    listed = mutants.Project.load(mutants.ROOT)
    for module, tests in listed.tests.items():
        assert (listed.root / listed.package / module).is_file()
        for test in tests:
            assert (listed.root / test).exists()
    assert mutants.stale_explanations(listed) == []
