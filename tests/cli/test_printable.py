"""A terminal is not steered by what a file says, wherever it is shown."""

import re

import pytest
from rich.console import Console

from softfin.cli import main
from softfin.cli.output import print_result, progress

HOSTILE = "fin\x1b]0;owned\x07\x9b2J\u202e"
ESCAPED = r"fin\x1b]0;owned\x07\x9b2J\u202e"


def test_an_error_that_quotes_a_file_is_shown_without_its_escapes(capsys, tmp_path):
    (tmp_path / "a.csv").write_text(f"time,command angle,angle,{HOSTILE}\n0,1,2,3\n")
    with pytest.raises(SystemExit) as stop:
        main(["inspect", str(tmp_path)])
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert said.rstrip("\n").isprintable()
    assert r"fin\x1b" in said


def test_a_name_of_a_file_is_shown_without_its_escapes(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["inspect", str(tmp_path / HOSTILE)])
    said = capsys.readouterr().err
    assert ESCAPED in said
    assert said.rstrip("\n").isprintable()


def test_results_are_shown_without_escapes_and_in_lines(capsys):
    print_result(f"{HOSTILE}: well\nsecond line", as_json=False)
    assert capsys.readouterr().out == f"{ESCAPED}: well\nsecond line\n"


def test_results_fit_on_a_terminal_and_their_commands_can_be_copied(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    command = f"next: softfin train surrogate --out {'x' * 30}"
    text = f"  {'five ' * 12}\n\n{command}"
    print_result(text, as_json=False)
    assert capsys.readouterr().out == f"{text}\n"
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    print_result(text, as_json=False)
    *wrapped, empty, last = capsys.readouterr().out.splitlines()
    assert (empty, last) == ("", command)
    assert len(wrapped) == 3
    assert all(line.startswith("  ") and len(line) <= 30 for line in wrapped)


@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_shows_neither_escapes_nor_markup(capsys, monkeypatch, is_terminal):
    monkeypatch.setattr(
        "rich.console.Console",
        lambda stderr: Console(stderr=stderr, force_terminal=is_terminal, width=150),
    )
    with progress() as report:
        report("read", 0.5, HOSTILE + "[/nothing] [blink]x")
        report("read", 1.0, HOSTILE + "[/nothing] [blink]x")
    said = capsys.readouterr().err
    assert f"{ESCAPED}[/nothing] [blink]x" in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said)
    assert "\x1b]0;" not in said
    assert "\x9b" not in said
