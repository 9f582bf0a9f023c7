import json
import os
import pty
import signal
from pathlib import Path

import pytest

from softfin.cli import main
from softfin.rig.arming import listen_on_terminal
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.stop import StopRequest
from tests.cli.terminal import Terminal
from tests.cli.test_cli import fails
from tests.control.folders import folder_option
from tests.rig.bags import counts_of, events_of
from tests.rig.rigs import filed, over_sockets, simulated


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    return folder_option("single", tmp_path_factory.mktemp("controller"))


@pytest.fixture
def emulated():
    with simulated() as behind:
        yield behind


@pytest.fixture
def plant(emulated, tmp_path):
    """For this process."""
    with filed(emulated, tmp_path / "rig.yaml") as file:
        yield f"rig:{file}"


@pytest.fixture
def elsewhere(tmp_path):
    """In real time, for another process: rig:other.yaml."""
    with over_sockets(tmp_path / "other.yaml") as behind:
        yield behind


def still(emulated):
    assert emulated.drive.state in (State.SWITCH_ON_DISABLED, State.FAULT)
    assert emulated.fin.now().velocity == 0.0


RUN = ("--reference=1,-1", "--seconds", "1")


def test_a_controller_runs_for_so_long_and_says_what_it_made(
    controller, plant, emulated, tmp_path, capsys
):
    bag = tmp_path / "a.mcap"
    main(
        [
            "run",
            str(controller),
            "--plant",
            plant,
            *RUN,
            "--arm",
            "--yes",
            "--bag",
            str(bag),
            "--json",
        ]
    )
    told = json.loads(capsys.readouterr().out)
    assert told["seconds"] == 1.0
    assert told["counters"]["sensor_records"] > 0
    active, rest, inactive = events_of(bag)
    assert (active, inactive) == ("active: rig of emulated", "inactive")
    assert rest.startswith("force at rest: (")
    assert counts_of(bag)["/fin/command"] >= 5
    still(emulated)


def test_nothing_moves_without_arm(controller, plant, emulated, tmp_path, capsys):
    line, code = fails(capsys, "run", str(controller), "--plant", plant, *RUN)
    assert line.endswith("nothing moves without --arm")
    assert code == 2
    assert emulated.fin.now().angle == 0.0
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--plant", "tank", *RUN], "plant tank: not a real fin; use rig"),
        (["--reference=1,1", "--reference-file", "x.csv"], "use either --reference=X,Y or"),
        ([], "use either --reference=X,Y or --reference-file"),
        (["--reference=1,1", "--seconds", "0"], "--seconds 0: must be at least 1"),
        (["--reference=one,1"], "not a force; use X,Y"),
        (["--reference=nan,1"], "nan"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_opened(
    words, expected, controller, plant, capsys
):
    plant = [] if "--plant" in words else ["--plant", plant]
    line, code = fails(capsys, "run", str(controller), *plant, *words, "--arm", "--yes")
    assert expected in line
    assert code == 2


def test_a_stop_is_exit_code_three_with_the_reason_and_a_whole_bag(
    controller, emulated, tmp_path, capsys
):
    file = tmp_path / "rig.yaml"
    bag = tmp_path / "a.mcap"
    narrow = {"force_peak_n": 0.2, "force_sustained_n": 0.1}
    with filed(emulated, file, **narrow), pytest.raises(SystemExit) as ended:
        # Long enough for a peak; the first one ends it.
        main(
            [
                "run",
                str(controller),
                "--plant",
                f"rig:{file}",
                RUN[0],
                "--seconds",
                "30",
                "--arm",
                "--yes",
                "--bag",
                str(bag),
            ]
        )
    assert ended.value.code == 3
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("softfin run: stopped, motor disabled: force ")
    assert said[-1].endswith("check whether the fin touches something")
    assert "stopped: force_peak: force " in events_of(bag)[-1]
    still(emulated)


@pytest.mark.real_time
def test_the_state_is_updated_in_place_above_what_is_typed(controller, elsewhere, tmp_path):
    with Terminal(["run", controller, "--plant", "rig:other.yaml", *LIVE], tmp_path) as terminal:
        started(terminal)
        terminal.wait_for("3.0 s  target")
        # One line with the state, and one that says what may be typed.
        shown = terminal.said[terminal.said.index("1.0 s  target") :]
        assert shown.count("\n") == 1
        assert shown.count("type X,Y for a new target, or press Enter alone to stop the fin: ") == 1
        terminal.type("2,0.5\n")
        terminal.wait_for("target (+2.00, +0.50) N")
        shown = terminal.said[terminal.said.index("2,0.5") :]
        assert "press Enter alone to stop the fin: " in shown
        terminal.signal(signal.SIGINT)
        assert terminal.ended() == 3
        assert "s, error over the last 2 s (" in terminal.said
        assert "a.mcap: " in terminal.said


def started(terminal):
    terminal.wait_for("Type 'move' and press Enter: ")
    terminal.type("move\n")
    terminal.wait_for("1.0 s  target")


LIVE = ("--reference=1,-1", "--arm", "--bag", "a.mcap")


@pytest.mark.real_time
def test_enter_on_the_terminal_stops_and_a_typed_reference_is_taken(
    controller, elsewhere, tmp_path
):
    with Terminal(["run", controller, "--plant", "rig:other.yaml", *LIVE], tmp_path) as terminal:
        started(terminal)
        terminal.type("2,0.5\n")
        terminal.wait_for("target (+2.00, +0.50) N")
        terminal.type("hello\n")
        terminal.wait_for("type X,Y in newtons")
        terminal.type("\n")
        assert terminal.ended() == 3
        *_, summary, reason = terminal.said.rstrip().splitlines()
        assert summary.startswith("a.mcap: ")
        assert "s, error over the last 2 s (" in summary
        assert reason == "softfin run: stopped, motor disabled: stopped by a key"
        assert "Traceback" not in terminal.said
        assert "Fatal" not in terminal.said
    still(elsewhere)
    assert events_of(tmp_path / "a.mcap")[-1] == "stopped: emergency_stop: stopped by a key"


@pytest.mark.real_time
def test_a_run_that_ends_by_itself_leaves_no_thread_at_the_terminal(
    controller, elsewhere, tmp_path
):
    with Terminal(
        ["run", controller, "--plant", "rig:other.yaml", *LIVE, "--seconds", "1"], tmp_path
    ) as terminal:
        started(terminal)
        assert terminal.ended() == 0, terminal.said
        assert "Fatal" not in terminal.said
    still(elsewhere)


@pytest.mark.real_time
@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_signals_stop_the_fin(name, controller, elsewhere, tmp_path):
    with Terminal(["run", controller, "--plant", "rig:other.yaml", *LIVE], tmp_path) as terminal:
        started(terminal)
        terminal.signal(getattr(signal, name))
        if name == "SIGINT":
            terminal.signal(signal.SIGINT)
        assert terminal.ended() == 3, terminal.said
        assert f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}" in terminal.said
        assert "Traceback" not in terminal.said
    still(elsewhere)
    assert "stopped: emergency_stop" in events_of(tmp_path / "a.mcap")[-1]


@pytest.mark.real_time
def test_a_word_that_was_typed_before_the_question_is_no_answer(controller, elsewhere, tmp_path):
    with Terminal(["run", controller, "--plant", "rig:other.yaml", *LIVE], tmp_path) as terminal:
        terminal.type("move\n")
        terminal.wait_for("Type 'move' and press Enter: ")
        terminal.type("no\n")
        assert terminal.ended() == 2
        assert "not confirmed with 'move'; nothing moved" in terminal.said
    assert elsewhere.fin.now().angle == 0.0


@pytest.mark.real_time
@pytest.mark.parametrize("answer", ["no\n", None])
def test_without_the_word_nothing_moves(answer, controller, elsewhere, tmp_path):
    with Terminal(["run", controller, "--plant", "rig:other.yaml", *LIVE], tmp_path) as terminal:
        terminal.wait_for("Type 'move' and press Enter: ")
        if answer is None:
            terminal.signal(signal.SIGINT)
            assert terminal.ended() == 1
        else:
            terminal.type(answer)
            assert terminal.ended() == 2
            assert "not confirmed with 'move'; nothing moved" in terminal.said
    assert elsewhere.fin.now().angle == 0.0
    assert elsewhere.drive.state is State.SWITCH_ON_DISABLED
    assert not list(Path(tmp_path).glob("*.mcap"))


def test_topics_are_refused_where_time_is_simulated(controller, plant, capsys):
    line, code = fails(
        capsys, "ros2", str(controller), "--plant", plant, "--reference=1,0", "--arm", "--yes"
    )
    assert (
        "rig of emulated: emulated in simulated time, which does not work with topics; start "
        "softfin rig" in line
    )
    assert code == 2


def test_a_signal_stops_a_fin_in_simulated_time_too(controller, plant, emulated, tmp_path, capsys):
    def interrupt():
        emulated.clock.sleep(4.0)
        # While this thread runs, that of the loop waits.
        signal.raise_signal(signal.SIGINT)

    emulated.clock.spawn(interrupt, "somebody at the terminal")
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "run",
                str(controller),
                "--plant",
                plant,
                *LIVE[:2],
                "--yes",
                "--bag",
                str(tmp_path / "a.mcap"),
            ]
        )
    assert ended.value.code == 3
    assert capsys.readouterr().err.rstrip().endswith("stopped, motor disabled: stopped by Ctrl-C")
    still(emulated)


@pytest.mark.parametrize(("command", "key"), [("collect", "\n"), ("evaluate", "\x04")])
def test_a_key_stops_a_fin_that_moves_by_itself(command, key, controller, plant, tmp_path):
    """The process on the terminal emulates the rig itself, in simulated time: neither a busy
    computer nor another rig at the same port can stop it first."""
    words, moving = {
        "collect": (["collect", "--logs", "1", "--test-logs", "0", "--rows", "20000"], " N, "),
        # Progress is shown before each repetition, so the fin has moved when the second starts.
        "evaluate": (["evaluate", controller, "--seconds", "3", "--repeats", "99"], "repetition 2"),
    }[command]
    with Terminal([*words, "--plant", plant, "--out", "out", "--arm"], tmp_path) as terminal:
        # The word between is coloured, as everything in quotes above a progress bar.
        terminal.wait_for(" and press Enter: ")
        terminal.type("move\n")
        terminal.wait_for(moving)
        terminal.type("faster\n")
        terminal.wait_for("the commands are fixed; press Enter alone to stop the fin")
        terminal.type(key)
        assert terminal.ended() == 3, terminal.said
    reason = "stopped by a key" if key == "\n" else "the terminal input ended"
    assert f"softfin {command}: stopped, motor disabled: {reason}" in terminal.said
    (bag,) = (tmp_path / "out-bags").glob("*.mcap")
    events = events_of(bag)
    assert events[0] == "active: rig of emulated"
    assert events[-1].startswith(f"stopped: emergency_stop: {reason}")


def test_a_job_in_the_background_does_not_read_the_terminal(monkeypatch):
    monkeypatch.setattr("softfin.rig.arming.on_terminal", lambda: True)
    monkeypatch.setattr(
        "softfin.rig.arming.listen_to_keyboard", lambda *_: pytest.fail("reads the terminal")
    )
    master, slave = pty.openpty()
    with os.fdopen(master), os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("os.tcgetpgrp", lambda descriptor: os.getpgrp() + 1)
        listen_on_terminal(StopRequest(), print)
