import json

import jax
import numpy as np
import pytest

from softfin.control.controller import Controller
from softfin.core.errors import CoverageError, PlantError
from softfin.core.quantities import Command
from softfin.evaluation.evaluate import (
    EvaluateConfig,
    score_controller,
    together,
    write_evaluation,
)
from softfin.evaluation.experiment import run, run_together
from softfin.evaluation.figures import moving_figure
from softfin.evaluation.moving_references import (
    STEP_SECONDS,
    MovingPlan,
    default_steps,
    plan_moving,
)
from softfin.evaluation.range_errors import controller_range
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.references import PAPER_CELLS, PAPER_RANGE
from softfin.task.signals import Recorded, step
from tests.evaluation.test_evaluate import Exploding, Untouched
from tests.plants import AnalyticFin, Flapper

KEYS = jax.random.split(jax.random.key(0), 2)
STEP = step((1, 0), (2, 0), 3)


class Covering(Flapper):
    """Covers some cells, and turns to an angle that tells the reference."""

    cells: tuple[Cell, ...] = PAPER_CELLS

    def act(self, state, measured, reference):
        return state, Command(0.1 * reference[0], 3.0 + 0.1 * reference[1])

    def check(self, reference):
        if min(cell.distance(reference) for cell in self.cells) > 0:
            raise CoverageError(f"reference {reference}: not covered")


@pytest.fixture(scope="module")
def moving():
    plan = MovingPlan.of("steps", Flapper(), (STEP, step((2, 1), (2, 1))), 6)
    return plan.score(run(Covering(), AnalyticFin(), plan.tracked, plan.seconds, KEYS))


def test_the_controller_sees_the_reference_when_it_acts(moving):
    np.testing.assert_allclose(
        moving.recording.command.angle[0, 0], 0.1 * STEP.sample(600)[:, 0], rtol=1e-6
    )


def test_a_step_between_two_actions_is_seen_at_the_second():
    between = step((1, 0), (2, 0), 3.1)
    plan = MovingPlan.of("steps", Flapper(), (between,), 6)
    recording = plan.score(
        run(Covering(), AnalyticFin(), plan.tracked, plan.seconds, KEYS)
    ).recording
    np.testing.assert_allclose(
        recording.command.angle[0, 0, [310, 332, 333, 599]], [0.1, 0.1, 0.2, 0.2], rtol=1e-6
    )


def test_references_that_run_side_by_side_make_what_they_make_alone():
    experiments = [(np.array([[1.0, 0.0], [2.0, 0.5]]), 3), (STEP.sample(600)[None], 6)]
    plant = AnalyticFin(noise_n=0.2)
    for recording, (references, seconds) in zip(
        run_together(Covering(), plant, experiments, KEYS), experiments, strict=True
    ):
        alone = run(Covering(), plant, references, seconds, KEYS)
        np.testing.assert_array_equal(recording.reference, references)
        np.testing.assert_allclose(recording.command.angle, alone.command.angle, rtol=1e-6)
        np.testing.assert_allclose(
            recording.reading.force, alone.reading.force, rtol=1e-5, atol=1e-5
        )


def test_evaluations_are_put_together_with_each_as_one_repetition():
    stepped = step((1, -1), (2, 0), 3)
    config = EvaluateConfig(references=((1, 1), (2, 0)), seconds=3, seeds=2, recorded=stepped)
    each = [
        score_controller(Covering(), AnalyticFin(noise_n=0.5), config.changed([f"seed={seed}"]))
        for seed in (0, 1, 2)
    ]
    whole = together(each).summary()
    parts = [evaluation.summary() for evaluation in each]
    assert whole["conditions"]["seeds"] == 3
    for rows in (
        lambda summary: summary["references"][1],
        lambda summary: summary["mean"],
        lambda summary: summary["moving"][0],
    ):
        own = [rows(summary)["x"]["error_n"] for summary in parts]
        assert rows(whole)["x"]["error_seeds_n"] == pytest.approx(own)
        assert rows(whole)["x"]["error_n"] == pytest.approx(np.mean(own))
    (row,) = whole["moving"]
    assert row["settling_s"] == [[None]] * 6
    assert row["settles"] is False


def test_every_signal_has_errors_and_the_answers_to_its_steps(moving):
    stepped, hold = moving.rows()
    assert (stepped["described"], stepped["duration_s"]) == ("step (1, 0) to (2, 0) N at 3 s", 6)
    assert stepped["settling_s"] == [[None], [None]]
    assert (stepped["settles"], stepped["longest_settling_s"]) == (False, None)
    assert stepped["x"]["error_interval_n"] is None
    assert stepped["x"]["error_n"] == pytest.approx(np.mean(stepped["x"]["error_seeds_n"]))
    assert (hold["settling_s"], hold["settles"]) == ([[], []], None)
    json.dumps(moving.rows(), allow_nan=False)


def test_the_default_steps_lie_within_the_papers_range_and_its_cells():
    (plan,) = plan_moving(Covering(), True, None)
    assert plan.signals == default_steps(PAPER_RANGE)
    assert plan.signals[0] == step((2, 0), (3, 0))


def test_the_default_steps_keep_to_another_range():
    class Weak(Covering):
        cells: tuple[Cell, ...] = (Cell(low=(0.1, -0.2), high=(0.5, 0.3)),)

    (plan,) = plan_moving(Weak(), True, None)
    series = np.concatenate([signal.sample(STEP_SECONDS * 100) for signal in plan.signals])
    assert series.min(axis=0).tolist() > [0.1, -0.2]
    assert series.max(axis=0).tolist() < [0.5, 0.3]


def test_default_steps_beyond_the_fins_reach_are_brought_to_its_edge():
    reachable = Reachable(np.float32([2, 0]), np.full(64, 0.5, np.float32))
    small, both, *_ = default_steps(PAPER_RANGE, reachable)
    np.testing.assert_allclose(small.force_n, [[2, 0], [2.5, 0]], atol=1e-3)
    np.testing.assert_allclose(both.force_n[0], [2 - 0.5**1.5, -(0.5**1.5)], atol=2e-3)


class Weak(Covering):
    """Covers the paper's range, in a fin that reaches x = 2 N."""

    cells: tuple[Cell, ...] = (PAPER_RANGE,)
    reachable: Reachable = Reachable(np.float32([1, 0]), np.full(64, 1.0, np.float32))


def test_a_moving_reference_beyond_reach_is_brought_to_it_and_told():
    recorded = Recorded(time_s=(0, 3), force_n=((1, 0), (3, 0)))
    config = EvaluateConfig(references=((1, 0),), seconds=3, seeds=1, recorded=recorded)
    summary = score_controller(Weak(), AnalyticFin(), config).summary()
    assert (
        "step (1, 0) to (3, 0) N at 3 s: this fin cannot produce the target force during 3 of 6 s, "
        "starting at 3 s" in summary["warning"]
    )
    (plan,) = plan_moving(Weak(), False, recorded)
    np.testing.assert_allclose(plan.tracked[0, [0, 299, 300, 599], 0], [1, 1, 2, 2], atol=2e-3)


def test_strictly_it_is_refused_with_time_and_force():
    recorded = Recorded(time_s=(0, 3), force_n=((1, 0), (3, 0)))
    with pytest.raises(
        CoverageError,
        match=r"this fin cannot .* starting at 3 s, and misses it by up to 1\.000 N; remove --strict",
    ):
        score_controller(
            Weak(),
            Untouched(),
            EvaluateConfig(references=((1, 0),), recorded=recorded, strict=True),
        )


def test_the_missed_force_of_a_small_fin_has_more_decimals():
    class Small(Covering):
        cells: tuple[Cell, ...] = (Cell(low=(0.0, -0.1), high=(0.2, 0.1)),)
        reachable: Reachable = Reachable(np.float32([0.05, 0]), np.full(64, 0.05, np.float32))

    recorded = Recorded(time_s=(0, 3), force_n=((0.05, 0), (0.1234, 0)))
    with pytest.raises(CoverageError, match=r"misses it by up to 0\.0234 N"):
        list(plan_moving(Small(), False, recorded, strict=True))


def test_a_controller_without_cells_has_the_papers_range():
    assert isinstance(Flapper(), Controller)
    assert controller_range(Flapper()) == controller_range(Covering()) == PAPER_RANGE


def test_a_recorded_reference_outside_the_range_is_refused_before_anything_runs():
    recorded = Recorded(time_s=(0, 4), force_n=((1, 1), (1, 0)))
    with pytest.raises(CoverageError, match=r"\(1\.0, 0\.0\): not covered"):
        score_controller(Covering(), Untouched(), EvaluateConfig(recorded=recorded))


def test_a_plant_that_gives_no_finite_force_is_named_with_the_reference_of_the_moment():
    plan = MovingPlan.of("steps", Flapper(), (step((1, 0), (2, 0), 1),), 3)
    with pytest.raises(
        PlantError, match=r"reference \(2, 0\) N, seed 0, 2\.01 s: force is not finite"
    ):
        plan.score(run(Covering(), Exploding(), plan.tracked, plan.seconds, KEYS))


def test_the_evaluation_holds_what_moves_and_its_figures(tmp_path):
    recorded = Recorded(time_s=(0, 3), force_n=((1, 1), (2, 0)))
    config = EvaluateConfig(
        references=((1, 1),), seconds=3, seeds=2, moving=True, recorded=recorded
    )
    summary = write_evaluation(
        score_controller(Covering(), AnalyticFin(), config), tmp_path / "out"
    )
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text()) == summary
    assert len(summary["moving"]) == 5
    assert summary["moving"][-1]["duration_s"] == 6
    names = {f"{name}.png" for name in ("experiments", "steps", "recorded", "fin")}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*names, "evaluation.json"}


def test_without_being_asked_for_nothing_moves():
    evaluation = score_controller(Covering(), AnalyticFin(), EvaluateConfig(seconds=3))
    assert "moving" not in evaluation.summary()


def test_the_figure_shows_the_reference_beside_the_moving_average(moving):
    axes = moving_figure(moving).get_axes()
    assert len(axes) == 6
    shown = {line.get_label(): line for line in axes[1].get_lines()}
    np.testing.assert_array_equal(shown["reference"].get_ydata(), STEP.sample(600)[:, 0])
    average = shown["moving average over 2 s"]
    np.testing.assert_allclose(average.get_xdata()[[0, -1]], [2, 6])
    assert average.get_ydata()[0] == pytest.approx(
        moving.recording.reading.force[0, 0, :200, 0].mean(), abs=1e-6
    )
    assert axes[1].get_title(loc="left").startswith("step (1, 0) to (2, 0) N at 3 s\nerror ")
    assert axes[1].get_title(loc="left").endswith("settling time: never")
