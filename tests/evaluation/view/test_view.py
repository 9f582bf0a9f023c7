import json

import jax.numpy as jnp
import numpy as np
import pytest

import softfin
from softfin.cli import main
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import CommandError, ConfigurationError, CoverageError
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from softfin.core.randomness import named_key
from softfin.evaluation import experiment
from softfin.evaluation.view.view import (
    StrokeGaitConfig,
    ViewConfig,
    record_footage,
    stroke_gait,
    view_title,
)
from softfin.gaits.reachable import Cell, Reachable
from tests.evaluation.view.fins import BendingFin, OffsetSensor
from tests.plants import Flapper

PLANT = "tests.evaluation.view.fins:BendingFin"


def fails(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(["view", *words])
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("view: ")]
    assert len(lines) == 1
    return lines[0], stop.value.code


def test_under_a_controller_the_fin_moves_as_in_the_experiment_and_the_reference_is_kept():
    fin = BendingFin()
    config = ViewConfig(seconds=1.5)
    footage = record_footage(fin, config, Flapper(), (1.0, -1.0))
    key = named_key(0, "view/plant")[None]
    recording = experiment.run(Flapper(), fin, jnp.asarray([[1.0, -1.0]]), 2, key)
    np.testing.assert_array_equal(footage.command.angle, recording.command.angle[0, 0, :150])
    np.testing.assert_allclose(
        footage.reading.force, recording.reading.force[0, 0, :150], atol=1e-4
    )
    np.testing.assert_array_equal(footage.reference, np.tile([1.0, -1.0], (150, 1)))


class Pointer(Flapper):
    """Turns to the angle that is the reference in x, so that its commands tell what it was asked
    for."""

    def act(self, state, measured, reference):
        return state, Command(0.1 * reference[0], jnp.float32(3.0))

    def check(self, reference):
        if reference[0] > 5:
            raise CoverageError(f"reference {reference}: not covered")


def test_references_follow_one_another_for_equal_parts_of_the_time():
    config = ViewConfig(seconds=6, next_references=((2.0, 0.0), (3.0, 1.0)))
    footage = record_footage(BendingFin(), config, Pointer(), (1.0, -1.0))
    np.testing.assert_array_equal(
        footage.reference[[0, 199, 200, 399, 400, 599], 0], [1, 1, 2, 2, 3, 3]
    )
    np.testing.assert_allclose(footage.command.angle, 0.1 * footage.reference[:, 0], rtol=1e-6)
    title = view_title("tank", config, (1.0, -1.0))
    assert (
        title == "A soft fin in the virtual tank, target (1, \u22121), then (2, 0), then (3, 1) N"
    )


def test_a_later_reference_that_the_controller_does_not_cover_is_refused():
    with pytest.raises(CoverageError, match="not covered"):
        record_footage(
            BendingFin(), ViewConfig(next_references=((6.0, 0.0),)), Pointer(), (1.0, -1.0)
        )


def test_random_commands_depend_on_the_seed_and_stay_within_the_limits():
    fin = BendingFin()
    angles = [
        record_footage(fin, ViewConfig(seconds=3, random=True, seed=seed)).command.angle
        for seed in (0, 0, 1)
    ]
    np.testing.assert_array_equal(angles[0], angles[1])
    assert (angles[0] != angles[2]).any()
    assert len(np.unique(angles[0])) > 2
    assert np.abs(angles[0]).max() <= fin.limits.angle_max


def test_the_command_writes_a_page_and_tells_what_it_shows(capsys, tmp_path):
    out = tmp_path / "fin.html"
    main(
        [
            "view",
            "--plant",
            PLANT,
            "--out",
            str(out),
            "--seconds",
            "2.5",
            "--centre",
            "0.4",
            "--json",
        ]
    )
    told = json.loads(capsys.readouterr().out)
    assert told["view"] == str(out)
    assert told["seconds"] == 2.5
    assert told["shape_known"] is True
    assert told["title"] == f"A soft fin in {PLANT}, beating about 0.4 rad"
    # Beating about a positive angle pushes towards -y.
    assert told["mean_force_n"][1] < 0 < told["mean_force_n"][0]
    assert told["title"] in out.read_text()


def test_the_mean_force_of_a_small_fin_has_more_decimals(capsys, tmp_path, monkeypatch):
    told = {"mean_force_n": [0.0123, -0.1487], "frames": None, "force": "reading", "warning": None}
    monkeypatch.setattr(
        "softfin.stages.evaluation.view", lambda *_, **__: told | {"title": "a", "seconds": 1.0}
    )
    main(["view", "--out", str(tmp_path / "fin.html")])
    assert "mean force (0.012, -0.149) N" in capsys.readouterr().out


def test_the_stage_writes_a_gif_with_the_frames_that_it_tells(tmp_path):
    config = ViewConfig(seconds=0.4, frames_per_second=50, dots_per_inch=50)
    told = softfin.view(BendingFin(), tmp_path / "fin.gif", config)
    assert told["frames"] == 20
    assert told["title"].startswith("A soft fin in BendingFin")
    assert (tmp_path / "fin.gif").read_bytes()[:6] == b"GIF89a"


def test_the_mean_force_is_the_true_one_where_it_is_known(tmp_path):
    config = ViewConfig(seconds=1)
    read = softfin.view(BendingFin(), tmp_path / "read.html", config)
    known = softfin.view(OffsetSensor(), tmp_path / "known.html", config)
    assert known["mean_force_n"] == pytest.approx(read["mean_force_n"], abs=1e-3)
    assert (read["force"], known["force"]) == ("reading", "true force")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["--out", "fin.avi"],
            "--out fin.avi: unsupported file type; a view must be one of .gif, .html, .png",
        ),
        (["--out", "fin"], "a view must be one of .gif"),
        (
            ["--out", "there.html"],
            "there.html: already exists; choose another --out, or use --overwrite to replace it",
        ),
        (
            ["--out", "folder.gif", "--overwrite"],
            "folder.gif: already exists and is not a file; choose another --out",
        ),
        (["--out", "fin.gif", "--plant", "pool"], "plant pool: unknown (does not exist)"),
        (
            ["--out", "fin.gif", "--seconds", "0"],
            "seconds = 0.0: Input should be greater than or equal to 0.1",
        ),
        (["--out", "fin.gif", "--set", "frames_per_second=30"], "Input should be 10, 20, 25 or 50"),
        (["--out", "fin.gif", "--set", "dots_per_inch=75"], "Input should be a multiple of 10"),
        (
            ["--out", "fin.gif", "--centre", "1.4"],
            "command angle = 1.9 rad: the plant accepts -1.5708 to 1.5708 rad",
        ),
        (["--out", "fin.gif", "--reference=1,1"], "a controller needs a reference, and vice versa"),
        (
            ["--out", "fin.gif", "--next-reference=1,1"],
            "without a first one; set a controller and a reference",
        ),
        (
            ["--out", "fin.gif", "--next-reference=1"],
            "--next-reference 1: not a force; use X,Y in newtons",
        ),
        (["--out", "fin.gif", "--reference=1;1"], "--reference 1;1: not a force"),
        (
            ["--out", "fin.gif", "--controller", "none"],
            "none: no such folder; it must be a controller",
        ),
    ],
)
def test_wrong_input_is_one_line_and_leaves_everything_as_it_was(
    capsys, tmp_path, monkeypatch, words, expected
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "there.html").write_text("mine")
    (tmp_path / "folder.gif").mkdir()
    line, code = fails(capsys, *(words if "--plant" in words else [*words, "--plant", PLANT]))
    assert expected in line
    assert code == 2
    assert (tmp_path / "there.html").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"there.html", "folder.gif"}


def test_overwrite_replaces_a_file(tmp_path):
    out = tmp_path / "fin.html"
    out.write_text("old")
    softfin.view(BendingFin(), out, ViewConfig(seconds=0.2), overwrite=True)
    assert "<canvas" in out.read_text()


def test_a_controller_and_random_commands_at_once_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("softfin.stages.evaluation.load_controller", lambda path: Flapper())
    with pytest.raises(
        ConfigurationError, match="random commands and a controller cannot be combined; use one"
    ):
        softfin.view(
            BendingFin(),
            tmp_path / "f.gif",
            ViewConfig(random=True),
            controller=tmp_path,
            reference=(1.0, 0.0),
        )


def test_a_reference_beyond_reach_is_brought_to_it_and_told(tmp_path, monkeypatch):
    class Weak(Pointer):
        limits = PAPER_LIMITS
        cell = Cell(low=(-3, -3), high=(3, 3))
        reachable = Reachable(np.float32([0, 0]), np.full(64, 1.0, np.float32))

    monkeypatch.setattr("softfin.stages.evaluation.load_controller", lambda path: Weak())
    config = ViewConfig(seconds=0.2, next_references=((0.5, 0.0),))
    metadata = softfin.view(
        "tests.evaluation.view.fins:BendingFin",
        tmp_path / "f.html",
        config,
        controller=tmp_path,
        reference=(2.0, 0.0),
    )
    assert metadata["warning"].startswith("reference (2, 0) N: this fin cannot produce it")
    assert metadata["title"].endswith("target (1, 0), then (0.5, 0) N")


def test_strokes_go_to_either_side_of_the_centre_on_the_action_clock():
    command = stroke_gait(StrokeGaitConfig(centre_rad=0.3), PAPER_LIMITS, 200)
    assert command.angle.shape == command.velocity.shape == (200,)
    turns = np.flatnonzero(np.diff(command.angle)) + 1
    np.testing.assert_array_equal(turns, np.cumsum(PAPER_CLOCK.ticks * 2)[:-1])
    np.testing.assert_allclose(command.angle[[0, 40]], [0.8, -0.2], rtol=1e-6)


def test_a_gait_of_six_actions_is_as_long_as_the_window_of_the_mean():
    command = stroke_gait(StrokeGaitConfig(), PAPER_LIMITS, 400)
    np.testing.assert_array_equal(command.angle[:200], command.angle[200:])


@pytest.mark.parametrize(("fastest", "expected"), [(20.0, 4.5), (3.0, 3.0)])
def test_the_velocity_fills_two_thirds_of_an_action_where_the_plant_is_fast_enough(
    fastest, expected
):
    command = stroke_gait(StrokeGaitConfig(), Limits(-1.5, 1.5, 0.5, fastest), 10)
    np.testing.assert_allclose(command.velocity, expected)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"centre_rad": 1.3}, "command angle = 1.8 rad: the plant accepts -1.5708 to 1.5708 rad"),
        (
            {"velocity_rad_s": 30.0},
            "command velocity = 30 rad/s: the plant accepts 1 to 3.14159 rad/s",
        ),
    ],
)
def test_commands_outside_the_limits_are_refused_in_one_line(values, words):
    with pytest.raises(CommandError, match=r"^[^\n]+$") as error:
        stroke_gait(StrokeGaitConfig(**values), PAPER_LIMITS, 10)
    assert words in str(error.value)
