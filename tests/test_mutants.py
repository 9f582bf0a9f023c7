"""The tool that tests tests, on two modules of a few lines."""

import json
import subprocess
import sys
import textwrap
from collections import Counter
from pathlib import Path

import pytest
from tools import mutants

FILES = {
    "src/tiny/limit.py": """
def is_within(value: float, low: float, high: float) -> bool:
    return low <= value <= high
""",
    "tests/test_limit.py": """
from tiny.limit import is_within

def test_inside_and_outside():
    assert is_within(1, 0, 2)
    assert not is_within(3, 0, 2)
    assert not is_within(-1, 0, 2)
""",
    "src/tiny/below/pause.py": """
def pause(event):
    event.is_set() and event.wait()
""",
    "tests/helper.py": "from tiny.below import pause",
    "tests/test_pause.py": """
import threading
from tests import helper

def test_there_is_no_pause():
    helper.pause.pause(threading.Event())
""",
    "src/tiny/alone.py": "LIMIT = 1",
    "tests/__init__.py": "",
    "tools/mutants.toml": """
package = "src/tiny"
left_out = []
last = []
[tests]
"alone.py" = ["tests/test_alone.py"]
""",
}
EXPLANATION = """
[[explained]]
module = "limit.py"
before = "return low <= value <= high"
after = "return {after}"
reason = "equality of two floats"
"""


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    return tmp_path


def mutated_lines(source: str) -> set[str]:
    return {
        mutation.after for mutation in mutants.find_mutations("module.py", textwrap.dedent(source))
    }


@pytest.mark.parametrize(
    ("source", "lines"),
    [
        ("near = a < b", {"near = a <= b", "near = a >= b"}),
        ("same = (a) is not (b)", {"same = a is b"}),
        ("rest = a - b", {"rest = a + b"}),
        ("either = a or b", {"either = a and b"}),
        ("free = not full", {"free = full"}),
        ("half = 0.5", {"half = 1.5", "half = 1.0", "half = -0.5"}),
        ("first = 0", {"first = 1"}),
        ("fresh = True", {"fresh = False"}),
        ("worst = max(loads)", {"worst = min(loads)"}),
        ("force = wrench[:three]", {"force = wrench[:three + 1]", "force = wrench[:three - 1]"}),
        ("motor.stop()", {"pass"}),
        ("motor.state = off", {"pass"}),
        ("turned = cross(a, b)", {"turned = cross(b, a)"}),
        ("if hot: stop = 'now'", {"if not hot:"}),
        ("run(lambda: a > b)", {"run(lambda: a >= b)", "run(lambda: a <= b)", "pass"}),
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
        "motor.stop(now)",
        "pass",
    )


def test_the_draw_is_even_over_packages_and_the_same_for_a_seed(tiny: Path) -> None:
    for name in ("one.py", "two.py", "below/three.py"):
        (tiny / "src/tiny" / name).write_text("low = [1, 2, 3, 4, 5, 6]\nhigh = a < b\n")
    project = mutants.Project(tiny)
    modules = ["one.py", "two.py", "below/three.py"]
    drawn = mutants.draw(project, modules, 8, seed=5)
    count = Counter(mutation.module for mutation in drawn)
    assert count == {"one.py": 2, "two.py": 2, "below/three.py": 4}
    assert len(set(drawn)) == 8
    assert mutants.draw(project, modules, 8, seed=5) == drawn
    assert mutants.draw(project, modules, 8, seed=6) != drawn


def test_the_tests_of_a_module_mirror_it_or_are_the_nearest_that_import_it(tiny: Path) -> None:
    (tiny / "tests/test_nearer.py").write_text("import tiny.limit")
    project = mutants.Project(tiny)
    assert project.tests("limit.py") == ["tests/test_limit.py", "tests/test_nearer.py"]
    assert project.tests("below/pause.py") == ["tests/test_pause.py"]
    assert project.tests("alone.py") == ["tests/test_alone.py"]


def test_an_explanation_needs_its_mutant(tiny: Path) -> None:
    kept = EXPLANATION.format(after="low < value <= high")
    stale = EXPLANATION.format(after="low <= value < low")
    (tiny / "tools/mutants.toml").write_text(FILES["tools/mutants.toml"] + kept + stale)
    project = mutants.Project(tiny)
    reasons = [project.reason(mutation) for mutation in project.mutations("limit.py")]
    assert sorted(reasons) == ["", "", "", "", "equality of two floats"]
    assert project.stale_explanations() == [
        "limit.py: `return low <= value <= high` -> `return low <= value < low`"
    ]


def run(root: Path, *arguments: str) -> tuple[int, Counter[tuple[str, str]]]:
    """Run the tool; return its exit code and how often it reported each outcome."""
    tool = mutants.ROOT / "tools" / "mutants.py"
    command = [sys.executable, str(tool), "--root", str(root), *arguments]
    code = subprocess.run(command, capture_output=True).returncode
    rows = json.loads((root / "build/mutants.json").read_text())
    return code, Counter((row["module"], row["status"]) for row in rows)


@pytest.mark.slow
def test_weak_tests_let_mutants_survive_and_an_endless_one_is_killed(tiny: Path) -> None:
    subprocess.run(["git", "init", "-q", str(tiny)], check=True)
    code, outcomes = run(tiny, "--modules", "limit.py", "below", "--silence", "5")
    assert code == 1
    assert outcomes == {
        ("limit.py", "killed"): 3,
        ("limit.py", "survived"): 2,
        ("below/pause.py", "timeout"): 1,
    }
    assert (tiny / "src/tiny/limit.py").read_text() == FILES["src/tiny/limit.py"]

    with (tiny / "tests/test_limit.py").open("a") as strong:
        strong.write("    assert is_within(0, 0, 2) and is_within(2, 0, 2)\n")
    code, outcomes = run(
        tiny, "--modules", "limit.py", "--repeat", str(tiny / "build/mutants.json")
    )
    assert code == 0
    assert outcomes == {("limit.py", "killed"): 5}


@pytest.mark.slow
def test_tests_that_fail_without_a_mutant_are_an_error(tiny: Path) -> None:
    subprocess.run(["git", "init", "-q", str(tiny)], check=True)
    (tiny / "tests/test_limit.py").write_text("def test_none(): assert False")
    tool = mutants.ROOT / "tools" / "mutants.py"
    command = [sys.executable, str(tool), "1", "--root", str(tiny), "--modules", "limit.py"]
    error = subprocess.run(command, capture_output=True, text=True).stderr
    assert error.startswith("tests/test_limit.py::test_none: fails without a mutant")


def test_the_tests_of_the_configuration_exist() -> None:
    project = mutants.Project(mutants.ROOT)
    for module in project.modules([]):
        assert all((project.root / test).exists() for test in project.tests(module))
