import time
from types import SimpleNamespace

import numpy as np
import pytest

from softfin import cli
from softfin.control.controller import Artifact, LoadedController
from softfin.core.errors import CoverageError
from softfin.core.quantities import Command, Limits
from softfin.gaits.reachable import Cell, Reachable
from softfin.rig.machine import Machine, Sample
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.ros2.config import Ros2PlantConfig
from softfin.rig.ros2.plant import Ros2Machine
from softfin.rig.safety import SafetyConfig
from softfin.stages import driving
from tests.rig.ros2_memory import MemoryTransport

LIMITS = Limits(-1.5, 1.5, 1.0, 3.0)

TOPICS = {
    "joint_topic": "/joint",
    "joint_name": "fin",
    "wrench_topic": "/wrench",
    "frame": "x,y",
    "command_topic": "/fin/command",
    "limits": LIMITS.to_dict(),
}


class StillFin:
    """A machine that stays at angle 0."""

    name = "still"
    limits = LIMITS
    notes = ()
    stop_unconfirmed = None

    def __init__(self):
        self.commands = []
        self.stops = 0
        self.on_enable = lambda: None
        self.reads = 0

    def open(self):
        pass

    def read(self):
        self.reads += 1
        now = time.monotonic()
        return Sample(now, 0.0, 0.0, None, None, now, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0), ())

    def enable(self):
        self.on_enable()

    def command(self, target):
        self.commands.append(target)

    def stop(self):
        self.stops += 1

    def close(self):
        pass

    def counters(self):
        return {"lost": 0}


class Controller(LoadedController):
    """Notes what it is asked for; asks for nothing but angle 0."""

    limits = LIMITS
    cells = ()
    reachable = None
    artifact = Artifact()

    def __init__(self):
        object.__setattr__(self, "asked", [])

    def init(self):
        return None

    def act(self, state, measured, reference):
        self.asked.append(reference)
        return state, Command(0.0, 1.0)

    def check(self, reference):
        if abs(reference[0]) > 3:
            raise CoverageError(f"reference {reference}: not trained for")


@pytest.fixture
def there(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "controller").mkdir()
    for file in ("controller/controller.json", "rig.yaml", "ros2.yaml"):
        (tmp_path / file).touch()
    fin = StillFin()
    controller = Controller()
    transport = MemoryTransport(time.monotonic)
    safety = SafetyConfig(stale_s=1.0, force_stale_s=1.0, overrun_s=1.0, watchdog_s=2.0)
    assert isinstance(fin, Machine)
    monkeypatch.setattr(driving, "load_controller", lambda folder: controller)
    monkeypatch.setattr(driving, "find_robot", lambda name: RobotSetup(fin, safety, settle_s=0.0))
    monkeypatch.setattr("softfin.rig.ros2.plant.open_transport", lambda config: transport)
    return SimpleNamespace(fin=fin, controller=controller, transport=transport)


def run(*words):
    cli.main(["ros2", "controller", *words])


def test_references_of_the_topic_are_held_and_every_sample_goes_out(there, tmp_path, capsys):
    messages = there.transport.messages

    def ask():
        for x in (2.0, np.nan, 5.0, 1.0):
            there.transport.put("/ask", messages.wrench(0, "", (x, -1.0, 0.0, 0.0, 0.0, 0.0)))

    there.fin.on_enable = ask
    run(
        "--reference=0,0.5",
        "--arm",
        "--yes",
        "--seconds",
        "3",
        "--bag",
        str(tmp_path / "run.mcap"),
        "--json",
        "--reference-topic",
        "/ask",
        "--reference-timeout-s",
        "1.5",
    )
    assert there.controller.asked[0] == (1.0, -1.0)
    assert there.controller.asked[-1] == (0.0, 0.5), "too old: what was said beforehand"
    assert (
        len(there.transport.sent["/fin/joint_states"])
        == len(there.transport.sent["/fin/wrench"])
        == there.fin.reads
    )
    assert there.transport.sent["/fin/command"]
    out, err = capsys.readouterr()
    assert '"references_refused": 2' in out
    assert '"unsent": 0' in out
    assert "in memory" in err
    assert "/ask: no reference for 1.5 s" in err
    assert (tmp_path / "run.mcap").is_file()
    assert there.fin.stops
    assert there.transport.closed


def test_the_limit_of_references_covers_what_the_controller_was_trained_for(
    there, tmp_path, monkeypatch
):
    messages = there.transport.messages
    monkeypatch.setattr(Controller, "cells", (Cell(low=(0, -30), high=(30, 30)),))
    monkeypatch.setattr(Controller, "check", lambda self, reference: None)
    there.fin.on_enable = lambda: there.transport.put(
        "/fin/reference", messages.wrench(0, "", (29.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    )
    bag = str(tmp_path / "run.mcap")
    run("--reference=0,0", "--arm", "--yes", "--seconds", "1", "--bag", bag)
    assert there.controller.asked[0] == (29.0, 0.0)


def test_the_lines_have_more_decimals_for_a_small_fin(there, tmp_path, monkeypatch, capsys):
    region = Reachable(np.zeros(2, np.float32), np.full(8, 0.15, np.float32))
    monkeypatch.setattr(Controller, "reachable", region)
    bag = str(tmp_path / "run.mcap")
    run("--reference=0.1234,0", "--arm", "--yes", "--seconds", "1", "--bag", bag)
    err = capsys.readouterr().err
    assert "target (+0.123, +0.000) N  mean (+0.5000, +0.0000) N" in err


def test_a_stop_of_the_topic_ends_it_with_its_own_exit_code(there, tmp_path, capsys):
    messages = there.transport.messages
    there.transport.put("/fin/stop", messages.make("std_msgs/msg/Bool", True))
    with pytest.raises(SystemExit) as stop:
        run(
            "--reference=0,0",
            "--arm",
            "--yes",
            "--seconds",
            "5",
            "--bag",
            str(tmp_path / "run.mcap"),
        )
    assert stop.value.code == 3
    assert "emergency stop on /fin/stop" in capsys.readouterr().err
    assert not there.controller.asked
    assert there.transport.closed


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "nothing moves without --arm"),
        (["--arm"], "in a script, add --yes"),
        (["--reference=4,0"], "not trained for"),
        (["--joint-topic", "joint"], "joint_topic = 'joint'"),
        (["--domain", "300"], "--domain 300"),
        (["--fin", "left fin"], "fin 'left fin': cannot be part of a topic name"),
        (
            ["--fin", "left", "--reference-timeout-s", "null"],
            "reference_lost = stop: needs a timeout",
        ),
    ],
)
def test_what_cannot_be_is_told_in_one_line_before_anything_moves(there, words, said, capsys):
    with pytest.raises(SystemExit) as stop:
        run(*words, *([] if "--reference=4,0" in words else ["--reference=0,0"]))
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert said in err.splitlines()[-1]
    assert not there.fin.commands


def test_a_fin_of_a_robot_has_its_own_topics_and_stops_with_exit_code_3_when_references_end(
    there, tmp_path, capsys
):
    messages = there.transport.messages

    def ask():
        there.transport.put(
            "/tail/reference", messages.wrench(0, "", (2.0, -1.0, 0.0, 0.0, 0.0, 0.0))
        )

    there.fin.on_enable = ask
    with pytest.raises(SystemExit) as stop:
        run(
            "--reference=0,0",
            "--fin",
            "tail",
            "--arm",
            "--yes",
            "--seconds",
            "60",
            "--bag",
            str(tmp_path / "a.mcap"),
        )
    assert stop.value.code == 3
    assert "/tail/reference: no reference for 1 s" in capsys.readouterr().err
    assert there.controller.asked[0] == (2.0, -1.0)
    assert {"/tail/joint_states", "/tail/wrench", "/tail/command"} == set(there.transport.sent)
    assert {"/tail/reference", "/tail/stop"} == set(there.transport.asked)


def test_a_topic_of_the_fins_own_is_not_spoken_on(there, monkeypatch, capsys):
    machine = Ros2Machine(Ros2PlantConfig.build(TOPICS))
    monkeypatch.setattr(driving, "find_robot", lambda name: RobotSetup(machine, SafetyConfig()))
    with pytest.raises(SystemExit):
        run("--plant", "ros2", "--reference=0,0")
    assert "command_topic = /fin/command: already a topic of the fin" in capsys.readouterr().err
