import os
import signal
import subprocess
import sys

import pytest

from softfin.cli import COMMANDS, main


def fails(capsys, *words):
    """The one line on standard error, and the exit code."""
    with pytest.raises(SystemExit) as stop:
        main(words)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert "Traceback" not in lines[0]
    return lines[0], stop.value.code


def test_help_lists_every_command(capsys):
    main(["--help"])
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in COMMANDS)
    assert "softfin --version" in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["colect"], "unknown command 'colect'; use demo, example, doctor, collect, "),
        (
            ["collect", "--out", "x", "--logs", "0"],
            "logs = 0: Input should be greater than or equal to 1",
        ),
        (["collect", "--out", "x", "--excitation.hold-min", "1"], "did you mean 'hold_min_s'?"),
        (
            ["train", "tests.plants:AnalyticFin", "--steps", "3", "--out", "x"],
            "steps = 3: fewer than one rollout",
        ),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch, words, expected):
    monkeypatch.chdir(tmp_path)
    line, code = fails(capsys, *words)
    assert expected in line
    assert line.startswith("softfin")
    assert code == 2
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_nothing_half_written_and_says_how_to_go_on(capsys, tmp_path, monkeypatch):
    def interrupted(*words, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("softfin.data.recordings.open_logs", interrupted)
    (tmp_path / "log.csv").touch()
    line, code = fails(capsys, "fit", str(tmp_path / "log.csv"), "--out", str(tmp_path / "s"))
    assert line == (
        "softfin fit: stopped; no incomplete files were left; run it again with --resume to continue"
    )
    assert code == 1


@pytest.mark.parametrize(
    ("words", "can_resume"), [([], False), (["--plant", "rig"], True), (["--plant=ros2"], True)]
)
def test_ctrl_c_advises_resume_only_if_the_recording_can_be_continued(
    capsys, tmp_path, monkeypatch, words, can_resume
):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("softfin.stages.collect.check_seed", interrupted)
    line, code = fails(capsys, "collect", "--out", str(tmp_path / "d"), *words)
    assert ("--resume" in line) is can_resume
    assert code == 1


def test_a_full_disk_is_one_line_that_names_the_folder(capsys, tmp_path, monkeypatch):
    def full(*words, **options):
        raise OSError(28, "No space left on device", "train/0000.parquet")

    monkeypatch.setattr("softfin.data.collect.collect_logs", full)
    line, code = fails(capsys, "collect", "--out", str(tmp_path / "d"))
    assert "train/0000.parquet: No space left on device" in line
    assert code == 1


def test_debug_shows_the_traceback():
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "softfin.cli",
            "collect",
            "--plant",
            "pool",
            "--out",
            "x",
            "--debug",
        ],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    assert "Traceback" in run.stderr


def in_shell(line):
    """Run a line of Bash in which $softfin is the command; return its exit code and its output."""
    environment = {**os.environ, "softfin": f"{sys.executable} -m softfin.cli"}
    run = subprocess.run(["bash", "-c", line], env=environment, capture_output=True, text=True)
    return run.returncode, run.stdout, run.stderr


def test_a_pipe_whose_reader_ends_first_ends_the_command_silently():
    code, out, err = in_shell("$softfin doctor | head -1; exit ${PIPESTATUS[0]}")
    assert (code, len(out.splitlines()), err) == (128 + signal.SIGPIPE, 1, "")


@pytest.mark.parametrize("stream", [0, 1, 2])
def test_a_standard_stream_that_the_shell_closed_changes_nothing_else(stream):
    code, out, err = in_shell(f"$softfin --version {stream}>&-")
    assert (code, err) == (0, "")
    assert bool(out) == (stream != 1)


@pytest.mark.parametrize("errors", ["2>&-", "2>/dev/full"])
def test_the_exit_code_does_not_depend_on_standard_error(errors):
    assert in_shell(f"$softfin unknown {errors}")[0] == 2


@pytest.mark.parametrize("words", ["--version", "doctor"])
def test_a_full_disk_behind_standard_output_is_one_line(words):
    code, _, err = in_shell(f"$softfin {words} >/dev/full")
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "No space left on device" in err
