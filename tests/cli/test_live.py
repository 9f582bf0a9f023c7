import io

import pytest

from softfin.core.errors import ConfigurationError
from softfin.rig.arming import Arming
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import SafetyConfig
from tests.rig.machines import FreeFin

BENCH = RobotSetup(FreeFin(), SafetyConfig())


class Typed(io.StringIO):
    def __init__(self, text, terminal=True):
        super().__init__(text)
        self._terminal = terminal

    def isatty(self):
        return self._terminal


def confirm(monkeypatch, text="", terminal=True, **options):
    monkeypatch.setattr("sys.stdin", Typed(text, terminal))
    Arming(**options).confirm(BENCH)


def test_nothing_moves_without_arm_whatever_else_is_said(monkeypatch):
    for options in ({}, {"yes": True}):
        with pytest.raises(
            ConfigurationError,
            match="free fin: connected, but not armed; nothing moves without --arm",
        ):
            confirm(monkeypatch, "move\n", **options)


def test_the_word_on_a_terminal_lets_it_move_and_the_question_says_how_far(monkeypatch, capsys):
    confirm(monkeypatch, "move\n", arm=True)
    asked = capsys.readouterr().err
    assert "will move between -1.57 and 1.57 rad, at up to 3.14 rad/s" in asked
    assert "Type 'move' and press Enter" in asked


@pytest.mark.parametrize("answer", ["", "\n", "Move\n", "yes\n", "y\n", "moved\n", "no move\n"])
def test_anything_else_does_not(answer, monkeypatch):
    with pytest.raises(ConfigurationError, match="not confirmed with 'move'; nothing moved"):
        confirm(monkeypatch, answer, arm=True)


def test_without_a_terminal_only_yes_lets_it_move(monkeypatch):
    with pytest.raises(ConfigurationError, match="in a script, add --yes"):
        confirm(monkeypatch, "move\n", terminal=False, arm=True)
    confirm(monkeypatch, terminal=False, arm=True, yes=True)
