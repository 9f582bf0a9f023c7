"""A function as a command: what is typed becomes its arguments."""

from typing import Annotated, Literal

import pytest

from softfin.cli.application import format_help, list_options, parse
from softfin.cli.output import print_result
from softfin.core.configuration import Changes
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import FORCE, HIDDEN, RECORDINGS, Config, Force
from softfin.core.result import Result
from softfin.data.importing.importing import ImportConfig


def work(
    *places: str,
    rate_hz: float = 1.5,
    kind: Literal["one", "two"] = "one",
    force: Annotated[tuple[Force, ...], FORCE] = (),
    fast: bool = False,
    recordings: Annotated[ImportConfig | None, RECORDINGS] = None,
    config: Config = None,
    hidden: Annotated[int, HIDDEN] = 3,
) -> None:
    """Do some work.

    Args:
        places: Where.
        rate_hz: How often.
        kind: Which.
        force: How strong.
        fast: Whether it is fast.
        recordings: What is read.
        config: Everything else.
        hidden: Not typed.
    """


def plain(place: str, /, *, out: str) -> None:
    """Do something else.

    Args:
        place: Where.
        out: To what.
    """


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (["--rate", "2"], {"rate_hz": 2.0}),
        (["--rate=-2"], {"rate_hz": -2.0}),
        (["--rate", "-2"], {"rate_hz": -2.0}),
        (["--force", "-1,-.5"], {"force": ((-1.0, -0.5),)}),
        (["--rate", "2", "--rate", "3"], {"rate_hz": 3.0}),
        (["--kind", "two", "--fast"], {"kind": "two", "fast": True}),
        (["--force", "1,-1", "--force=-1,2"], {"force": ((1.0, -1.0), (-1.0, 2.0))}),
        (["--test", "-x,y", "--fast"], {"recordings": ImportConfig(test="-x,y"), "fast": True}),
        (
            ["--columns", "angle=a,velocity=-", "--command-lag", "20", "--negate", "angle"],
            {
                "recordings": ImportConfig(
                    columns={"angle": "a", "velocity": "-"}, command_lag_ms=20, negate=("angle",)
                )
            },
        ),
    ],
)
def test_words_become_arguments(words, options):
    assert parse(work, ["here", *words, "there"]).args == ("here", "there")
    assert parse(work, words).keywords == options


def test_other_options_are_fields_of_the_configuration(tmp_path):
    words = ["--drive.units=3", "here", "--low", "-1.5", "--box", "[1, 2]"]
    call = parse(work, words)
    fields = {"--drive.units": "3", "--low": "-1.5", "--box": "[1, 2]"}
    assert call.args == ("here",)
    assert call.keywords["config"][:2] == (None, fields)
    file = tmp_path / "config.yaml"
    file.touch()
    assert parse(work, ["--config", str(file)]).keywords["config"] == Changes(
        file, {}, list_options(work)
    )


@pytest.mark.parametrize(
    ("function", "words", "named"),
    [
        (plain, ["here", "--ot", "there"], "--out"),
        (plain, ["here", "--out"], "--out"),
        (plain, ["here"], "--out"),
        (plain, ["--out", "there"], "PLACE"),
        (plain, ["--place"], "--place"),
        (plain, ["here", "more", "--out", "there"], "more"),
        (work, ["--rate", "fast"], "--rate"),
        (work, ["--kind", "tow"], "two"),
        (work, ["--force", "1"], "--force 1"),
        (work, ["--command-lag", "2000"], "--command-lag 2000"),
        (work, ["--columns", "angle"], "--columns angle"),
        (work, ["--fas"], "--fast"),
        (work, ["--fas", "here"], "--fas: unknown option, or missing value; did you mean --fast?"),
        (work, ["--negate", "speed"], "--negate speed: "),
        (work, ["--force", "nan,1"], "--force nan,1"),
        (work, ["--force=1,inf"], "--force 1,inf"),
        (work, ["--fast", "-1,2"], "-1"),
        (work, ["--low", "--fast"], "--low"),
    ],
)
def test_a_slip_is_one_line_that_names_the_option(function, words, named):
    with pytest.raises(ConfigurationError) as error:
        parse(function, words)
    assert named in str(error.value)
    assert "\n" not in str(error.value)


def test_the_help_shows_options_with_defaults_and_hides_what_cannot_be_typed():
    text = format_help(work, "softfin work", width=80)
    assert text.startswith("Usage: softfin work")
    assert "--rate FLOAT" in text
    assert "[default: 1.5]" in text
    assert "--hidden" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_result_is_printed_as_text_or_as_json(capsys):
    result = Result({"angle_rad": 1.5}, "the angle is 1.5 rad\n")
    print_result(result, as_json=False)
    assert capsys.readouterr().out == "the angle is 1.5 rad\n"
    print_result(result, as_json=True)
    assert capsys.readouterr().out == '{\n  "angle_rad": 1.5\n}\n'


@pytest.mark.parametrize(("as_json", "said"), [(False, "one\ntwo\n"), (True, '["one","two"]')])
def test_items_are_printed_even_if_an_error_follows(capsys, as_json, said):
    def items():
        yield "one"
        yield "two"
        raise ConfigurationError("enough")

    with pytest.raises(ConfigurationError):
        print_result(items(), as_json)
    assert "".join(capsys.readouterr().out.split()) == "".join(said.split())
