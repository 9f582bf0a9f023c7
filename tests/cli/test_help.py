"""The help of each command: a file that ``pytest tests/cli/test_help.py --rewrite`` writes anew."""

import re
from pathlib import Path

import pytest

from softfin.cli import COMMANDS, import_function
from softfin.cli.application import format_help, make_app

FOLDER = Path(__file__).parent / "help"
LONGEST = 90
"""Characters of an option's description, which may be followed by its default."""


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_is_the_one_on_file(name: str, request: pytest.FixtureRequest) -> None:
    text = format_help(import_function(name), f"softfin {name}", width=92) + "\n"
    file = FOLDER / f"{name.replace(' ', '-')}.txt"
    if request.config.getoption("--rewrite"):
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    assert file.read_text() == text


def test_no_file_is_left_of_a_command_that_there_is_no_more() -> None:
    names = {name.replace(" ", "-") for name in COMMANDS}
    assert {file.stem for file in FOLDER.glob("*.txt")} == names


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_described_in_a_line(name: str) -> None:
    app = make_app(import_function(name))
    for argument in app.assemble_argument_collection(parse_docstring=True):
        if argument.show:
            text = " ".join((argument.parameter.help or "").split())
            # Defaults that a function works out are in the text.
            described = re.sub(r" \(default: .*\)\.$", ".", text)
            assert 0 < len(described) <= LONGEST + 1, f"{argument.name}: {text}"
