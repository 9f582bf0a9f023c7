"""Options are the fields of a configuration: read, suggested, refused in one line, listed as
help."""

from pathlib import Path
from typing import Annotated, Literal

import pytest

from softfin.cli import COMMANDS, import_arguments
from softfin.cli.common import ForcePair
from softfin.cli.options import HelpRequested, Option, check_values, format_help, list_fields, parse
from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, ConfigurationError


class Base(Configuration):
    """Inherited."""

    loud: bool = False
    """Say more."""


class Example(Base):
    """An example of a command.

    With a second paragraph.
    """

    source: Annotated[Path, Option("SOURCE", positional=True)]
    """Where it
    comes from."""
    out: Path
    """Where it goes."""
    test_rows: int = 0
    """How many."""
    rate: float | None = None
    """How fast."""
    kind: Literal["first", "second"] = "first"
    """Which."""
    reference: tuple[ForcePair, ...] = ()
    """Forces."""
    more: Annotated[tuple[str, ...], Option("MORE", positional=True)] = ()
    """What follows."""


def test_words_become_the_fields_of_the_command() -> None:
    words = [
        "a",
        "--out",
        "b",
        "--test-rows=3",
        "--rate",
        "-1.5",
        "--kind",
        "second",
        "--loud",
        "c",
        "d",
        "--reference",
        "-1,2",
        "--reference=3,4",
    ]
    assert parse(Example, words) == Example(
        source=Path("a"),
        out=Path("b"),
        test_rows=3,
        rate=-1.5,
        kind="second",
        loud=True,
        more=("c", "d"),
        reference=((-1.0, 2.0), (3.0, 4.0)),
    )


def test_underscores_are_hyphens() -> None:
    read = parse(Example, ["--test_rows", "2", "--out=x=y", "odd"])
    assert (read.test_rows, read.out, read.source) == (2, Path("x=y"), Path("odd"))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--test-row", "3"], "--test-row: unknown option; did you mean --test-rows?"),
        (["--zzz"], "--zzz: unknown option; --help lists the options"),
        (["-o", "x"], "-o: unknown option; --help lists the options"),
        (["--test-rows", "many"], "--test-rows many: not a whole number; use --test-rows INT"),
        (["--rate", "fast"], "--rate fast: not a number; use --rate FLOAT"),
        (["--kind", "secnd"], "--kind secnd: must be one of first, second; did you mean second?"),
        (["--rate"], "--rate: missing value; use --rate FLOAT"),
        (["--rate", "--loud"], "--rate: missing value; use --rate FLOAT"),
        (
            ["--loud=1"],
            "--loud=1: this option does not accept a value; use --loud alone, or omit it",
        ),
        (["--out="], "--out: the path is empty; use --out PATH"),
        (["--reference=1;2"], "--reference 1;2: not a force; use X,Y in newtons, e.g. 1,-1"),
        (["--loud"], "missing required SOURCE, --out PATH; see --help"),
    ],
)
def test_a_mistake_is_one_line_with_the_way_out(words: list[str], line: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse(Example, words)
    assert str(refused.value) == line


class Renamed(Configuration):
    """A command whose option had another name."""

    repeats: Annotated[int, Option(former_name="--seeds")] = 1
    """How often."""
    seed: int = 0
    """Which numbers."""


def test_the_former_name_of_an_option_is_answered_with_the_new_one() -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse(Renamed, ["--seeds=3"])
    assert str(refused.value) == "--seeds: unknown option; did you mean --repeats?"


class Checked(Configuration):
    """A command whose paths must be there."""

    path: Annotated[Path | None, Option(check=lambda path, command: command.refuse(path))] = None
    paths: Annotated[
        tuple[Path, ...], Option(check=lambda path, command: command.refuse(path))
    ] = ()

    def refuse(self, path: Path) -> None:
        raise ArtifactError(f"{path}: refused")


def test_one_argument_too_many_is_refused() -> None:
    with pytest.raises(
        ConfigurationError, match="'a': unexpected argument; the command accepts only options"
    ):
        parse(Checked, ["a"])


def test_each_value_that_was_given_is_checked() -> None:
    check_values(Checked())
    for words in (["--path", "a"], ["--paths", "a"]):
        with pytest.raises(ArtifactError, match="a: refused"):
            check_values(parse(Checked, words))


def test_help_shows_what_is_required_first_and_every_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(HelpRequested):
        parse(Example, ["--zzz-is-not-looked-at=1", "-h"][1:])
    assert (
        format_help(Example, "example")
        == """\
usage: example SOURCE [MORE ...] --out PATH [OPTION ...]

An example of a command.

With a second paragraph.

arguments:
  SOURCE          Where it comes from
  MORE ...        What follows

options:
  --out PATH      Where it goes (required)
  --test-rows INT
                  How many (default: 0)
  --rate FLOAT    How fast
  --kind first|second
                  Which (default: first)
  --reference X,Y
                  Forces (may be repeated)
  --loud          Say more
  -h, --help      Show this help"""
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_every_command_names_kinds_of_values_and_describes_each_option(
    name: str,
) -> None:
    text = format_help(import_arguments(name), f"softfin {name}")
    assert "None" not in text
    assert "STR" not in text
    assert "('" not in text, "a default is shown as Python writes it"
    for field in list_fields(import_arguments(name)):
        assert field.usage in text
        if field.option.positional:
            assert field.choices or field.option.metavar, f"{field.field} has no name of its own"
        assert field.text, f"{field.field} is not described"
