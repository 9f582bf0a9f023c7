import json

import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.references import default_references
from softfin.core.errors import ArtifactError, ConfigurationError, CoverageError, PlantError
from softfin.evaluation.evaluate import (
    EvaluateConfig,
    Evaluation,
    score_controller,
    write_evaluation,
)
from tests.plants import AnalyticFin, Flapper, PlainFin

CONFIG = EvaluateConfig(references=((1, -1), (2, 0)), seconds=4, seeds=3)


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return score_controller(Flapper(), AnalyticFin(noise_n=0.3), CONFIG)


def test_the_paper_is_the_default():
    config = EvaluateConfig()
    assert (config.seconds, config.seeds) == (30, 5)
    # Those of the fin's reach, which are the paper's where that is unknown.
    assert config.references == ()
    assert default_references(None) == ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1))


def test_every_reference_and_axis_has_its_scores_and_intervals(evaluation):
    summary = evaluation.summary()
    assert [row["reference_n"] for row in summary["references"]] == [[1, -1], [2, 0]]
    for i, row in enumerate(summary["references"]):
        for k, axis in enumerate("xy"):
            assert set(row[axis]) == {
                f"{name}{part}_n"
                for name in ("error", "std", "raw_std")
                for part in ("", "_interval", "_seeds")
            }
            assert row[axis]["error_n"] == pytest.approx(evaluation.scores.error[i, :, k].mean())
            low, high = row[axis]["raw_std_interval_n"]
            assert low < row[axis]["raw_std_n"] < high
        assert row["still"] is False
        assert row["shaft_travel_rad_s"] > 1
    assert summary["conditions"]["window_samples"] == 200
    assert summary["conditions"]["seeds"] == 3
    assert (summary["kind"], summary["format"]) == ("evaluation", 2)
    assert [row["tracked_reference_n"] for row in summary["references"]] == [[1, -1], [2, 0]]


def test_the_mean_is_over_the_references(evaluation):
    summary = evaluation.summary()
    errors = [row["x"]["error_n"] for row in summary["references"]]
    assert summary["mean"]["x"]["error_n"] == pytest.approx(np.mean(errors))


def test_the_force_error_is_that_of_the_plant():
    """The analytic fin without noise: what the recording shows is what is scored."""
    evaluation = score_controller(Flapper(), AnalyticFin(noise_n=0.0), CONFIG)
    force = evaluation.recording.reading.force[1, 0]
    windows = np.lib.stride_tricks.sliding_window_view(force, 200, axis=0).mean(axis=-1)
    np.testing.assert_allclose(
        evaluation.scores.error[1, 0], np.abs(windows - [2, 0]).mean(axis=0), rtol=1e-4
    )


def test_one_seed_gives_null_for_its_intervals(tmp_path):
    config = EvaluateConfig(references=((1, 1),), seconds=3, seeds=1)
    write_evaluation(score_controller(Flapper(), AnalyticFin(), config), tmp_path / "out")
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert written["references"][0]["x"]["error_interval_n"] is None


def test_a_controller_that_does_not_move_is_said_to_stand_still():
    summary = score_controller(Flapper(angle=0.0), AnalyticFin(), CONFIG).summary()
    assert [row["still"] for row in summary["references"]] == [True, True]


def test_the_folder_holds_scores_conditions_and_figures(evaluation, tmp_path):
    summary = write_evaluation(
        evaluation, tmp_path / "out", {"controller": "flapper", "plant": "analytic"}
    )
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "evaluation.json",
        "experiments.png",
        "fin.png",
    ]
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert written == summary
    assert written["conditions"]["controller"] == "flapper"
    assert written["provenance"]["seed"] == 0


def test_an_evaluation_replaces_an_older_one_where_asked_and_nothing_else(evaluation, tmp_path):
    write_evaluation(evaluation, tmp_path / "out")
    with pytest.raises(ArtifactError, match="already exists"):
        write_evaluation(evaluation, tmp_path / "out")
    write_evaluation(evaluation, tmp_path / "out", {"plant": "another"}, overwrite=True)
    assert "another" in (tmp_path / "out" / "evaluation.json").read_text()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(ArtifactError, match="not a softfin folder"):
        write_evaluation(evaluation, tmp_path / "mine", overwrite=True)


def test_the_same_seed_gives_the_same_scores_and_another_seed_others(evaluation):
    again = score_controller(Flapper(), AnalyticFin(noise_n=0.3), CONFIG)
    other = score_controller(Flapper(), AnalyticFin(noise_n=0.3), CONFIG.changed(["seed=1"]))
    np.testing.assert_array_equal(again.scores.error, evaluation.scores.error)
    assert (other.scores.error != evaluation.scores.error).all()


class Untouched(PlainFin):
    """Must not be run."""

    def init(self, key):
        raise AssertionError


class Choosy(Flapper):
    """Knows no force beyond 1.5 N."""

    def check(self, reference):
        if max(map(abs, reference)) > 1.5:
            raise CoverageError(f"reference {reference}: not covered")


def test_a_reference_outside_what_the_controller_covers_is_refused_before_anything_runs():
    with pytest.raises(CoverageError, match=r"\(2\.0, 0\.0\): not covered"):
        score_controller(Choosy(), Untouched(), CONFIG)


class Exploding(PlainFin):
    """A plant whose force is lost after two seconds."""

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(
            force=jnp.where(reading.time[:, None] > 2.005, jnp.inf, reading.force)
        )


def test_a_plant_that_gives_no_finite_force_is_named_with_the_moment():
    with pytest.raises(
        PlantError, match=r"reference \(1, -1\) N, seed 0, 2\.01 s: force is not finite"
    ):
        score_controller(Flapper(), Exploding(), CONFIG)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"seconds": 2}, "greater than or equal to 3"),
        ({"seconds": 10.5}, "valid integer"),
        ({"seeds": 0}, "greater than or equal to 1"),
        ({"reference": [[1, 1]]}, "did you mean 'references'"),
    ],
)
def test_conditions_that_make_no_sense_are_refused(values, words):
    with pytest.raises(ConfigurationError, match=words):
        EvaluateConfig.build(values)
