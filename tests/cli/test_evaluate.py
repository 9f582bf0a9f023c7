import json

import numpy as np
import pytest

import softfin
from softfin.cli import main
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.reachable import Reachable
from softfin.tank import Tank, TankConfig
from softfin.tank.fin import FinConfig
from tests.evaluation.test_moving import Covering

QUICK = (
    "--plant",
    "tests.plants:AnalyticFin",
    "--seconds",
    "3",
    "--repeats",
    "1",
    "--reference=1,1",
)

TANK = Tank(TankConfig(fin=FinConfig(plates=2)))


class Loaded(Covering):
    kind = "single"
    limits = PAPER_LIMITS

    def act(self, state, measured, reference):
        state, command = super().act(state, measured, reference)
        # With feedback, the reference is corrected.
        return state, command._replace(velocity=min(command.velocity, PAPER_LIMITS.velocity_max))


@pytest.fixture
def controller(monkeypatch, tmp_path):
    monkeypatch.setattr("softfin.evaluation.evaluate.load_controller", lambda path: Loaded())
    monkeypatch.setattr("softfin.evaluation.evaluate.load_family", lambda path, controller: None)
    (tmp_path / "controller").mkdir()
    (tmp_path / "controller" / "controller.json").touch()
    return str(tmp_path / "controller")


def test_a_reference_file_goes_into_table_and_folder(controller, capsys, tmp_path):
    file = tmp_path / "reference.csv"
    file.write_text("time_s,force_x_n,force_y_n\n0,1,-1\n3,2,0\n")
    out = tmp_path / "out"
    options = ("--reference-file", str(file), "--moving")
    main(["evaluate", controller, *QUICK, "--out", str(out), *options])
    text = capsys.readouterr().out
    assert "moving references" in text
    assert [
        line.split()[-1]
        for line in text.splitlines()
        if " step (1, -1) to (2, 0) N at 3 s " in line
    ] == ["never"]
    assert sum("at 10 s" in line for line in text.splitlines()) == 4
    assert "paper" not in text
    written = json.loads((out / "evaluation.json").read_text())
    assert len(written["moving"]) == 5


def test_random_references_are_one_line_and_the_configuration_is_kept(controller, capsys, tmp_path):
    file = tmp_path / "reference.csv"
    file.write_text("time_s,force_x_n,force_y_n\n0,1,-1\n3,2,0\n")
    options = ("--random", "4", "--feedback", "--reference-file", str(file))
    main(["evaluate", controller, *QUICK, "--out", str(tmp_path / "out"), *options])
    assert "4 random references: error x, y mean " in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert len(written["random"]["errors_n"]) == written["configuration"]["random"] == 4
    assert written["configuration"]["feedback"]["drift_s"] == 300


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            "time_s,force_x_n,force_y_n\n0,1,nan\n",
            "row 1, column force_y_n: nan is not a finite number",
        ),
        (
            "time_s,force_x_kn,force_y_n\n0,1,1\n",
            "must have exactly one column force_x_n, got time_s, force_x_kn, force_y_n; convert "
            "a column to newtons",
        ),
        ("time_s,force_x_n,force_y_n\n0,9,1\n", "reference (9.0, 1.0): not covered"),
    ],
)
def test_a_wrong_reference_file_is_one_line_and_leaves_nothing(
    controller, capsys, tmp_path, rows, words
):
    file = tmp_path / "reference.csv"
    file.write_text(rows)
    with pytest.raises(SystemExit) as stop:
        main(
            [
                "evaluate",
                controller,
                *QUICK,
                "--out",
                str(tmp_path / "out"),
                "--reference-file",
                str(file),
            ]
        )
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert stop.value.code == 2
    assert not (tmp_path / "out").exists()


def test_a_misspelt_option_is_named_although_it_took_the_controller(controller, capsys):
    for option, nearest in (
        ("--feedbck", "--feedback"),
        ("--trim", "--feedback"),
        ("--sedes", "--seeds"),
    ):
        with pytest.raises(SystemExit):
            main(["evaluate", option, controller])
        line = capsys.readouterr().err
        assert f"{option}: unknown option" in line
        assert nearest in line


def test_a_randomization_is_for_the_tank(controller):
    with pytest.raises(
        ConfigurationError, match=r"randomize 0.0: requires the virtual tank as plant, got"
    ):
        softfin.evaluate(controller, plant="tests.plants:AnalyticFin", randomize=0.0)


def test_a_randomization_of_0_is_the_very_same_tank(controller):
    options = {"plant": TANK, "config": {"seconds": 3, "seeds": 1, "references": ((1, 1),)}}
    plain = softfin.evaluate(controller, **options)
    again = softfin.evaluate(controller, **options, randomize=0.0)
    assert again["references"] == plain["references"]


def test_controllers_of_several_seeds_are_the_repetitions_of_one_evaluation(controller):
    options = {"seconds": 3, "repeats": 1, "reference": ((1.0, 1.0),)}
    plant = "tests.plants:NoisyFin"
    both = softfin.evaluate(controller, controller, plant=plant, **options)
    each = [softfin.evaluate(controller, plant=plant, seed=seed, **options) for seed in (0, 1)]
    assert both["conditions"]["seeds"] == 2
    errors = [one["references"][0]["x"]["error_n"] for one in each]
    assert both["references"][0]["x"]["error_seeds_n"] == errors


class Weaker(Loaded):
    reachable = Reachable(np.float32([2, 0]), np.full(64, 0.5, np.float32))


class OfOtherKind(Loaded):
    kind = "grid"


class OfOtherClock(Loaded):
    clock = ActionClock.parse("6,1")


def evaluate_different(monkeypatch, controller, other, **options):
    """Evaluate two different controllers together."""
    loaded = iter([Loaded(), other()])
    monkeypatch.setattr("softfin.evaluation.evaluate.load_controller", lambda path: next(loaded))
    options = {"plant": "tests.plants:AnalyticFin", "seconds": 3, "repeats": 1, **options}
    return softfin.evaluate(controller, controller, **options)


@pytest.mark.parametrize("other", [OfOtherKind, OfOtherClock])
def test_controllers_of_different_kinds_or_clocks_are_refused(monkeypatch, controller, other):
    with pytest.raises(ConfigurationError, match="evaluate them separately"):
        evaluate_different(monkeypatch, controller, other, reference=((2.0, 0.0),))


@pytest.mark.parametrize(
    "options", [{}, {"reference": ((3.0, 0.0),)}, {"reference": ((2.0, 0.0),), "moving": True}]
)
def test_controllers_that_track_different_forces_are_refused(monkeypatch, controller, options):
    with pytest.raises(ConfigurationError, match="track different forces"):
        evaluate_different(monkeypatch, controller, Weaker, **options)


def test_controllers_with_different_reach_share_references_that_both_can_track(
    monkeypatch, controller
):
    summary = evaluate_different(monkeypatch, controller, Weaker, reference=((2.0, 0.0),))
    assert summary["references"][0]["tracked_reference_n"] == [2, 0]


def test_random_references_of_several_controllers_are_pooled(monkeypatch, controller):
    options = {"reference": ((2.0, 0.0),), "random": 5}
    summary = evaluate_different(monkeypatch, controller, Weaker, **options)
    assert len(summary["random"]["errors_n"]) == 10
    assert summary["random"]["worst_n"] == np.max(summary["random"]["errors_n"], axis=0).tolist()


@pytest.mark.parametrize(
    ("part", "told"),
    [
        ("-1", " -1: must be at least 0"),
        ("5", " 5: must be at least 0"),
        ("nan", " nan: must be at least 0"),
    ],
)
def test_a_randomization_out_of_range_is_one_line_that_says_what_is_allowed(
    controller, capsys, tmp_path, part, told
):
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", controller, f"--randomize={part}", "--out", str(tmp_path / "out")])
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert stop.value.code == 2
    assert not (tmp_path / "out").exists()


def test_a_field_of_feedback_has_a_value(controller, capsys):
    with pytest.raises(SystemExit):
        main(["evaluate", controller, "--feedback.uses", "torque"])
    assert "feedback.uses = torque: " in capsys.readouterr().err
