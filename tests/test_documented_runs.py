"""Every option of every command that README and docs show runs, shrunk by options that are added to
it and by nothing else."""

import contextlib
import runpy
import shlex
import shutil
from collections.abc import Mapping
from fnmatch import fnmatch
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from softfin.cli import main
from tests import staged
from tests.documents import ROOT, Shown, command_name, commands, softfin_words
from tests.staged import made, no_figures, short_search  # noqa: F401  # pytest finds fixtures here
from tests.test_golden import check_keys


def flat(values, path=""):
    """Nested values as options."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{name}.")
        else:
            yield f"--{path}{name}={value}".replace("_", "-")


TINY = {
    "collect": f"--logs 1 --test-logs 1 --rows {staged.ROWS}",
    "collect --plant tank": "--plant tank.yaml",
    "fit": "--config streaming.yaml",
    "fit --model paper": "--config paper.yaml",
    # The tiny surrogate has no torque; tests/gaits/test_power.py has a plant with it.
    "map --power": "--power 0",
    "calibrate": "--config calibrate.yaml --evaluations 0",
    "calibrate --config": "--config docs/calibration.yaml " + " ".join(flat(staged.CALIBRATE)),
    "train": "--config train.yaml",
    "train --range": "--range reach",
    "train --ppo.num-envs": "--ppo.num-envs 2 --ppo.num-epochs 1 --steps 6",
    "evaluate": f"--seconds 3 --repeats 1 --plant {staged.PLANT}",
    "evaluate --randomize": "--plant tank.yaml",
    "evaluate --random": "--random 4",
    "benchmark": "--plant tank.yaml --config benchmark.yaml",
    "inspect --rows-per-log": f"--rows-per-log {staged.ROWS}",
    "import-logs --rows-per-log": f"--rows-per-log {staged.ROWS}",
}
"""Options that are added to a command that has all of these words; of several entries the later
ones count."""

IN_THE_README = {
    # Fitted well enough that the forces exceed their noise, and mapped wherever they lie.
    "fit": "--force-updates 200",
    "map": "--config map.yaml --box null --spacing-n null --nodes 4",
    "family": "--plant tank.yaml --fins 20 --nodes 3 --nominal-nodes 3",
    "evaluate": "--plant tank.yaml",
    "rig --arm": "--yes",
    "run --arm": "--yes --seconds 1",
}
"""Options that are added to those of TINY where the commands of the README run one after the other:
smaller sizes, and what you would type while they run."""

IN_THE_DAY = (
    "rig emulate",
    "rig check",
    "rig check --prove --arm",
    "rig zero --arm",
    "collect --plant rig --out dataset --arm",
    "evaluate controller --plant rig --feedback --out evaluation --arm",
    "run controller --reference=2,0 --arm",
    "run controller --reference=2,0 --feedback --arm",
    "map surrogate --out controller",
)
"""Commands that need devices, which CI does at emulated ones: examples/rig_day.py."""

ELSEWHERE = {
    "demo": "tests/cli/test_demo.py",
    "benchmark gaits --feedback --out benchmark": "tests/evaluation/test_benchmark.py",
    "benchmark hand-gaits --plant examples/fins/hand.yaml --out benchmark-hand": "tests/evaluation/test_benchmark.py",
    "rig stop": "tests/cli/test_rig.py",
    "ros2 example/single --reference=2,0 --plant rig --arm": "tests/cli/test_ros2.py",
    "fit recordings --model softfin_gru:ARCHITECTURE --out surrogate": "tests/surrogate/test_registry.py",
    "rig emulate --real-time": "tests/test_wheel.py",
    "rig check --prove --moving --arm": "tests/rig/test_prove_moving.py",
    "monitor dataset-bags": "tests/cli/test_monitor.py",
    "benchmark entry:policy --out benchmark": "tests/evaluation/test_benchmark.py",
    "ros2 controller --fin front_left --reference=0,0 --plant rig:front_left.yaml --arm": "tests/cli/test_ros2.py",
    "map examples/fins/turning.yaml --out gaits": "tests/end_to_end/test_stages.py",
    "robot evaluate ucat gaits --plant examples/fins/turning.yaml --max-thrust 3 --out robot": "tests/cli/test_robot.py",
    "robot ros2 ucat --max-thrust 3": "tests/cli/test_robot.py",
    "reproduce --preset paper --plant tank --out run --resume": "tests/end_to_end/test_stages.py",
    "reproduce --preset paper --plant tank --out run-tank": "tests/end_to_end/test_stages.py",
}
"""Commands that need a partner, or minutes, and the tests that do the same with a partner or with
small stages."""


WHOLE_PAGES = {"docs/tutorials/5-arduino.md": "tests/examples/test_arduino.py"}
"""Pages whose commands run one after the other, and the tests that run them."""


def runs(shown: Shown) -> bool:
    """Whether a command is whole (in a sentence, one that says where its result goes), and run
    neither by the site nor with its page."""
    words = softfin_words(shown)
    return (
        bool(words)
        and not shown.in_cell
        and shown.document not in WHOLE_PAGES
        and (not shown.in_sentence or "--out" in words or "--onnx" in words)
    )


def used_options(shown: Shown) -> set[tuple[str, str]]:
    """Those of a command, which itself counts as one."""
    words = softfin_words(shown)
    command = command_name(words)
    return {(command, word.partition("=")[0]) for word in ("", *words) if word[:2] in ("", "--")}


README = [shown for shown in commands() if shown.document == "README.md" and runs(shown)]
"""In their order."""
AWAY = (*IN_THE_DAY, *ELSEWHERE)


def first_of_each_option() -> list[Shown]:
    """The longest commands, until each option of each command has run; that the others are
    understood is looked at in test_documentation.py."""
    ran = set().union(*map(used_options, README))
    chosen = []
    lines = {shlex.join(softfin_words(shown)): shown for shown in commands() if runs(shown)}
    for line in sorted(lines.keys() - set(AWAY), key=lambda line: (-len(line.split()), line)):
        if not used_options(lines[line]) <= ran:
            chosen.append(lines[line])
            ran |= used_options(lines[line])
    return chosen


HERE = first_of_each_option()


def added(words: tuple[str, ...], options: Mapping[str, str] = TINY) -> list[str]:
    """What shrinks a command."""
    return [
        word for entry, given in options.items() if is_like(entry, words) for word in given.split()
    ]


def is_like(entry, words):
    return entry.split()[0] == words[0] and set(entry.split()) <= set(words)


@pytest.fixture
def place(tmp_path, monkeypatch, short_search, no_figures):  # noqa: F811
    """The folder where one works, with the configurations that shrink."""
    for name, values in staged.CONFIGURATIONS.items():
        (tmp_path / name).write_text(yaml.safe_dump(values))
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "docs/calibration.yaml", tmp_path / "docs")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def named(words: tuple[str, ...]) -> list[str]:
    """Files and folders that a command reads."""
    places = {word for before, word in pairwise(words) if before in ("--out", "--onnx")}
    # A word may be a name and a choice, as in --controller single --out single.
    given = set(words[1:]) - places
    return [
        name
        for name in staged.MAKERS
        if any(
            fnmatch(name, word.rstrip("/")) or Path(word) in Path(name).parents for word in given
        )
    ]


def expand(word: str) -> list[str]:
    """As a shell does it, which leaves a pattern that fits no file, and what the document leaves
    out."""
    found = sorted(map(str, Path().glob(word))) if "*" in word else []
    return found or [staged.MAPPING if word == "..." else word]


@pytest.mark.slow
@pytest.mark.parametrize("shown", HERE, ids=str)
def test_a_command_of_the_documents_runs(shown, made, place, capsys):  # noqa: F811
    words = softfin_words(shown)
    for name in named(words):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).symlink_to(made(name))
    expanded = [found for word in words for found in expand(word)]
    told = contextlib.nullcontext() if not shown.fails else pytest.raises(SystemExit)
    with told as stop:
        main([*expanded, *added(words), "--debug"] if not shown.fails else list(words))
    assert not shown.fails or stop.value.code == 2
    for option in ("--out", "--onnx"):
        if option in words:
            written = Path(words[words.index(option) + 1])
            assert written.exists()
            check_keys(written)


@pytest.mark.slow
def test_the_commands_of_the_readme_run_one_after_the_other(place, capsys):
    """In a folder that is empty but for the files that shrink them, so each finds what those before
    it made."""
    assert len(README) > 1
    for shown in README:
        words = softfin_words(shown)
        main([*words, *added(words), *added(words, IN_THE_README), "--debug"])
        if "--out" in words:
            check_keys(Path(words[words.index("--out") + 1]))


def test_every_entry_stands_for_a_command_that_is_shown():
    here = [softfin_words(shown) for shown in HERE]
    for entry in TINY:
        assert any(is_like(entry, words) for words in here), f"TINY: nothing is shown like {entry}"
    for entry in IN_THE_README:
        assert any(is_like(entry, softfin_words(shown)) for shown in README), (
            f"IN_THE_README: nothing like {entry}"
        )
    lines = {shlex.join(softfin_words(shown)) for shown in commands() if runs(shown)}
    assert set(AWAY) <= lines, "a command that is no longer shown"


def test_the_day_at_the_rig_does_its_commands(monkeypatch, tmp_path):
    """With the same options, whatever their values."""
    done = []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evaluation").mkdir()
    score = '{"error_n": 0}'
    (tmp_path / "evaluation/evaluation.json").write_text(
        f'{{"mean": {{"x": {score}, "y": {score}}}}}'
    )
    script = runpy.run_path(str(ROOT / "examples/rig_day.py"))
    script["day"].__globals__["softfin"] = lambda *words: done.append(words)
    script["day"](quick=True)
    for line in IN_THE_DAY:
        names = {word.partition("=")[0] for word in line.split()}
        assert any(names <= {word.partition("=")[0] for word in words} for words in done), line


@pytest.mark.parametrize(("line", "test"), ELSEWHERE.items())
def test_what_runs_elsewhere_is_done_there(line, test):
    text = (ROOT / test).read_text()
    name, *rest = line.split()
    assert f'"{name}"' in text
    assert all(
        option in text for option in rest if option in ("--arm", "--plant", "--out", "--resume")
    ), line
