"""Progress where the output is no terminal: a line at both ends of a stage, and one every ten
seconds."""

import pytest

from softfin.cli.output import PACE_S, ProgressLines


@pytest.fixture
def lines():
    return ProgressLines(0.0)


def test_a_stage_is_told_when_it_begins_and_when_it_ends(lines, capsys):
    lines.report(0.0, "fit", 0.1, "drive networks")
    lines.report(1.0, "fit", 0.5, "drive networks")
    lines.report(2.0, "fit", 1.0, "force networks")
    lines.report(2.1, "fit", 1.0, "scores")
    assert capsys.readouterr().err == "fit: 10% drive networks\nfit: 100% force networks\n"


def test_lines_come_at_a_steady_pace_while_nothing_is_reported(lines, capsys):
    for tenth in range(1, 301):
        lines.write(tenth * PACE_S / 100)
    assert capsys.readouterr().err == ""
    lines.report(30.0, "map", 0.2, "")
    for tenth in range(1, 301):
        lines.write(30.0 + tenth * PACE_S / 100)
    assert len(capsys.readouterr().err.splitlines()) == 1 + 3


def test_a_stage_that_has_ended_is_told_once(lines, capsys):
    lines.report(0.0, "fit", 1.0, "")
    for second in range(1, 60):
        lines.write(float(second))
    assert capsys.readouterr().err == "fit: 100%\n"


def test_the_time_left_follows_from_what_was_done_since_the_first_report(lines, capsys):
    """The first report of a resumed stage, and of one that was compiled, says nothing of its
    pace."""
    lines.report(100.0, "train", 0.5, "")
    lines.report(110.0, "train", 0.6, "")
    assert capsys.readouterr().err.splitlines()[-1] == "train: 60% (about 0:40 left)"
    lines.write(125.0)
    assert capsys.readouterr().err == "train: 60% (about 0:25 left)\n"
    lines.write(205.0)
    assert capsys.readouterr().err == "train: 60%\n"


def test_each_stage_has_a_pace_of_its_own(lines, capsys):
    lines.report(0.0, "a", 0.0, "")
    lines.report(90.0, "a", 0.9, "")
    lines.report(91.0, "b", 0.0, "")
    lines.report(101.0, "b", 0.05, "")
    assert capsys.readouterr().err.splitlines()[-2:] == ["b: 0%", "b: 5% (about 3:10 left)"]
