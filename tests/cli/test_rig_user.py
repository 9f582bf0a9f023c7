"""What a new user gets wrong, and what must not be done to files: every time one line, and nothing
moves."""

import io
import sys

import pytest
import yaml

from softfin.cli.output import progress
from softfin.control.feedback import Feedback
from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError
from softfin.rig.arming import Arming
from softfin.rig.config import RigConfig
from softfin.rig.loop import ActionResult
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from softfin.stages import driving
from softfin.storage import artifact as artifacts
from tests.cli.test_cli import fails
from tests.control.folders import folder_option
from tests.rig.machines import FreeFin, Hours
from tests.rig.rigs import simulated

BENCH = RobotSetup(FreeFin(), SafetyConfig())


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    return folder_option("single", tmp_path_factory.mktemp("controller"))


@pytest.fixture(scope="module")
def values():
    with simulated() as emulated:
        return emulated.values()


def refused(capsys, told, words):
    line, code = fails(capsys, *told)
    assert words in line
    assert code == 2


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gear_ration", "unknown key 'drive.gear_ration'; did you mean 'gear_ratio'?"),
        (None, "drive.gear_ratio: missing required key"),
    ],
)
def test_a_key_of_the_rigs_file_is_named_where_it_is_misspelt_or_missing(
    controller, values, tmp_path, capsys, name, words
):
    drive = dict(values["drive"])
    ratio = drive.pop("gear_ratio")
    drive |= {} if name is None else {name: ratio}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(values | {"drive": drive}))
    told = [
        "run",
        str(controller),
        "--plant",
        f"rig:{tmp_path / 'rig.yaml'}",
        "--reference=1,0",
        "--arm",
        "--yes",
    ]
    refused(capsys, told, words)


def test_a_recording_or_folder_that_is_there_is_neither_moved_nor_replaced(
    controller, tmp_path, capsys
):
    (tmp_path / "a.mcap").write_text("of yesterday")
    (tmp_path / "folder.mcap").mkdir()
    run = [
        "run",
        str(controller),
        "--reference=1,0",
        "--arm",
        "--yes",
        "--plant",
        f"rig:{tmp_path / 'no.yaml'}",
    ]
    refused(
        capsys,
        [*run, "--bag", str(tmp_path / "a.mcap")],
        "a.mcap: already exists; choose a different --bag",
    )
    refused(
        capsys,
        [*run, "--bag", str(tmp_path / "folder.mcap"), "--overwrite"],
        "folder.mcap: already exists and is not",
    )
    assert (tmp_path / "a.mcap").read_text() == "of yesterday"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "folder.mcap"]


def test_zeroing_asks_for_what_it_does(values, monkeypatch, capsys):
    config = RigConfig.build(values)
    robot = RobotSetup(Rig(config), config.safety)
    with pytest.raises(
        ConfigurationError, match="rig of emulated: not armed; nothing moves without --arm"
    ):
        Arming().confirm(robot, "the motor is powered")
    monkeypatch.setattr(sys, "stdin", _Typed("move\n"))
    Arming(arm=True).confirm(robot, "the motor is powered")
    said = capsys.readouterr().err
    assert "rig of emulated: the motor is powered.\nPress Ctrl-C" in said
    assert "will move" not in said


class _Typed(io.StringIO):
    def isatty(self):
        return True


def test_lines_that_nobody_reads_any_more_stop_the_fin(controller, monkeypatch):
    def gone(*lines):
        raise BrokenPipeError(32, "Broken pipe")

    sample = Sample(0.0, 0.0, 0.0, None, None, 0.0, (0.0,) * 6, ())
    held = ActionResult((1.0, 0.0), Target(0.0, 1.0), [sample] * 100)
    monkeypatch.setattr(driving, "run_controller", lambda *_: iter([held]))
    monkeypatch.setattr(driving.STATUS, "show", gone)
    machine = FreeFin()
    session = Session(machine, Guard(SafetyConfig(), machine.limits))
    loaded = load_controller(controller)
    drive = driving.Drive(loaded, loaded, BENCH, Arming(), 1, None)
    list(drive._follow(session, lambda at: (1.0, 0.0), (0.0, 0.0), {}, "Enter"))
    assert session.stop_request.trip == (
        "emergency_stop",
        "the output is no longer being read (Broken pipe)",
    )


def test_the_errors_are_those_of_the_whole_last_window(controller, monkeypatch):
    def held(force):
        sample = Sample(0.0, 0.0, 0.0, None, None, 0.0, (force,) + (0.0,) * 5, ())
        return ActionResult((1.0, 0.0), Target(0.0, 1.0), [sample] * 33)

    forces = [5.0] * 4 + [1.0] * 3 + [0.0] * 3
    monkeypatch.setattr(driving, "run_controller", lambda *_: map(held, forces))
    machine = FreeFin()
    session = Session(machine, Guard(SafetyConfig(), machine.limits))
    loaded = load_controller(controller)
    drive = driving.Drive(loaded, loaded, BENCH, Arming(), None, None)
    result = {}
    list(drive._follow(session, lambda at: (1.0, 0.0), (0.0, 0.0), result, "Enter"))
    assert result["error_x_n"] == pytest.approx(0.5)
    assert result["window_s"] == 2


@pytest.mark.parametrize(("has_feedback", "lines"), [(True, 1), (False, 0)])
def test_feedback_names_the_key_without_which_the_current_is_not_used(
    controller, has_feedback, lines, capsys
):
    loaded = load_controller(controller)
    acting = Feedback(loaded) if has_feedback else loaded
    machine = FreeFin(Hours())
    session = Session(machine, Guard(SafetyConfig(), machine.limits))
    drive = driving.Drive(loaded, acting, BENCH, Arming(), 3, None)
    with session:
        session.activate()
        list(drive._follow(session, lambda at: (1.0, 0.0), (0.0, 0.0), {}, "Enter"))
    assert capsys.readouterr().err.count("drive.torque_constant_nm_a") == lines


def test_a_file_is_never_written_through_a_link_that_stands_in_its_way(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    monkeypatch.setattr(artifacts.os, "getpid", lambda: 7)
    (tmp_path / ".rig.yaml.7.partial").symlink_to(victim)
    artifacts.write_file(tmp_path / "rig.yaml", "fin: a")
    assert victim.read_text() == "mine"
    assert (tmp_path / "rig.yaml").read_text() == "fin: a"
    assert not (tmp_path / "rig.yaml").is_symlink()


def test_a_narrow_terminal_keeps_what_is_left_of_the_day(monkeypatch):
    from rich.console import Console

    said = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console", lambda stderr: Console(file=said, force_terminal=True, width=80)
    )
    with progress() as report:
        report("collect", 0.5, "6:03:00 left, train-0000: (+1.23, -0.45) N, -1.20 rad")
    assert "6:03:00 left, train-0000: (+1.2" in said.getvalue()
