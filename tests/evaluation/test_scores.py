import numpy as np
import pytest

from softfin.core.quantities import Command, Reading
from softfin.core.window import interval, moving_average
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_II
from softfin.evaluation.scores import (
    STILL_RAD_S,
    list_steps,
    score,
    settling_times,
    travel,
)
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.task.signals import Recorded, step

STEP = step((1, 0), (2, 0), 5).sample(1500).astype(float)


def record(
    force: np.ndarray, angle: np.ndarray | None = None, reference=(0.0, 0.0)
) -> ExperimentRecording:
    """One experiment of one seed from a force ``(ticks, 2)`` and an angle ``(ticks,)``."""
    ticks = len(force)
    angle = np.zeros(ticks) if angle is None else angle
    time = np.arange(1, ticks + 1) / 100
    batch = tuple(
        np.asarray(x, np.float32)[None, None] for x in (time, angle, np.zeros(ticks), force)
    )
    return ExperimentRecording(
        np.array([reference], np.float32), Command(batch[1], batch[1]), Reading(*batch)
    )


def test_the_moving_average_is_the_mean_of_each_full_window():
    series = np.random.default_rng(0).normal(size=(3, 450, 2))
    expected = np.stack([series[:, i : i + 200].mean(axis=1) for i in range(251)], axis=1)
    np.testing.assert_allclose(moving_average(series), expected, atol=1e-13)


def test_the_moving_average_keeps_its_digits_over_long_float32_series():
    series = (500 + np.random.default_rng(0).normal(size=(200_000, 1))).astype(np.float32)
    last = series[-200:].astype(np.float64).mean(axis=0)
    np.testing.assert_allclose(moving_average(series)[-1], last, rtol=1e-10)


def test_a_constant_force_errs_by_its_distance_from_the_reference():
    scores = score(record(np.full((3000, 2), [1.5, -0.5]), reference=(1.0, 1.0)))
    np.testing.assert_allclose(scores.error[0, 0], [0.5, 1.5], rtol=1e-6)
    np.testing.assert_allclose(scores.std[0, 0], 0, atol=1e-9)
    np.testing.assert_allclose(scores.raw_std[0, 0], 0, atol=1e-9)


def test_a_force_that_swings_with_the_window_has_no_error_and_no_std_but_a_raw_std():
    time = np.arange(3000) / 100
    swing = 5 * np.sin(2 * np.pi * time)
    scores = score(record(np.stack([swing, 1 + swing], axis=1), reference=(0.0, 1.0)))
    np.testing.assert_allclose(scores.error[0, 0], 0, atol=1e-6)
    np.testing.assert_allclose(scores.std[0, 0], 0, atol=1e-6)
    np.testing.assert_allclose(scores.raw_std[0, 0], 5 / np.sqrt(2), rtol=1e-5)


def test_errors_of_both_signs_do_not_cancel():
    force = np.concatenate([np.full((1500, 2), 1.0), np.full((1500, 2), -1.0)])
    scores = score(record(force))
    # In 200 of the 2801 windows the average passes from 1 to -1, with 0.5 as its mean distance.
    np.testing.assert_allclose(scores.error[0, 0], 1 - 200 / 2801 * 0.5, rtol=1e-3)
    assert (scores.std > 0.9).all()


def test_the_start_counts_from_the_first_full_window_on():
    force = np.zeros((3000, 2))
    force[:199] = 200.0
    scores = score(record(force))
    expected = sum(range(1, 200)) / 2801
    np.testing.assert_allclose(scores.error[0, 0], expected, rtol=1e-6)


def test_travel_is_the_path_between_the_ends_of_actions():
    stroke = np.repeat([0.5, -0.5], 100)
    angle = np.tile(stroke, 15)
    np.testing.assert_allclose(travel(angle), 29 / 29.67, rtol=1e-3)


def test_sensor_noise_on_a_resting_shaft_is_standing_still():
    noise = 1e-3 * np.random.default_rng(0).normal(size=3000)
    assert score(record(np.zeros((3000, 2)), noise)).late_travel[0, 0] < STILL_RAD_S


def test_a_fin_that_stops_after_a_while_is_seen():
    angle = np.sin(2 * np.pi * np.arange(3000) / 100 * 0.5)
    angle[1000:] = angle[1000]
    scores = score(record(np.zeros((3000, 2)), angle))
    assert scores.shaft_travel[0, 0] > STILL_RAD_S
    assert scores.late_travel[0, 0] == 0


@pytest.mark.parametrize(
    ("freedom", "quantile"), [(2, 4.3027), (4, 2.7764), (9, 2.2622), (30, 2.0423)]
)
def test_the_half_width_is_students_quantile_over_the_root_of_the_samples(freedom, quantile):
    values = np.arange(freedom + 1.0)
    low, high = interval(values)
    assert (high - low) / 2 == pytest.approx(
        quantile * values.std(ddof=1) / np.sqrt(freedom + 1), rel=1e-4
    )


def test_a_95_percent_interval_holds_the_mean_in_95_of_100_samples():
    samples = np.random.default_rng(0).normal(3.0, 2.0, size=(1500, 5))
    held = [low <= 3.0 <= high for low, high in map(interval, samples)]
    assert np.mean(held) == pytest.approx(0.95, abs=0.012)


def test_one_seed_or_two_have_no_interval():
    assert interval(np.array([1.0])) is None
    assert interval(np.array([1.0, 1.1])) is None


def test_seeds_that_are_all_alike_have_no_interval():
    """The true force of an open-loop controller is the same at every seed."""
    assert interval(np.full(5, 0.98973)) is None


def test_the_papers_rows_are_complete_and_its_printed_means_disagree_where_we_say():
    for controller, rows in PAPER_TABLE_II.items():
        assert tuple(rows) == PAPER_REFERENCES
        printed = PAPER_PRINTED_MEANS[controller]
        means = np.mean(list(rows.values()), axis=0)
        far = [abs(p - m) > 0.0015 for p, m in zip(printed, means, strict=True)]
        assert far == [controller == "grid"] * 4
    grid = np.mean(list(PAPER_TABLE_II["grid"].values()), axis=0)
    assert grid[3] == pytest.approx(0.293, abs=0.0005)


def late(series, ticks):
    """The same, so much later."""
    return np.concatenate([np.repeat(series[:1], ticks, axis=0), series[: len(series) - ticks]])


def test_a_force_that_jumps_with_its_reference_is_delayed_by_the_window_alone():
    assert list_steps(STEP) == [(500, len(STEP))]
    assert settling_times(STEP, STEP) == pytest.approx([1.6], abs=0.011)


def test_a_late_force_settles_later():
    assert settling_times(late(STEP, 100), STEP) == pytest.approx([2.6], abs=0.011)


def test_settling_is_on_both_axes_and_for_good():
    force = STEP.copy()
    # For 200 samples 0.5 N off in y, long after x is there: the average leaves the band of 0.2 N
    # and comes back.
    force[900:1100, 1] = 0.5
    expected = (1100 + 120 - 500) / 100
    assert settling_times(force, STEP) == pytest.approx([expected], abs=0.011)


def test_a_step_that_is_never_reached_has_no_time():
    reference = step((1, 0), (2, 0), 5).sample(1500).astype(float)
    assert np.isnan(settling_times(np.tile([1.0, 0.0], (1500, 1)), reference)).tolist() == [True]


def test_one_step_is_scored_up_to_the_next():
    reference = (
        Recorded(time_s=(0, 4, 9), force_n=((1, 0), (2, 0), (2, 2))).sample(1300).astype(float)
    )
    force = reference.copy()
    force[1000:] = 7
    first, second = settling_times(force, reference)
    assert first == pytest.approx(1.6, abs=0.011)
    assert np.isnan(second)


def test_only_changes_between_forces_held_for_a_window_are_steps():
    assert list_steps(step((1, 0), (2, 0), 2).sample(400)) == [(200, 400)]
    assert list_steps(step((1, 0), (2, 0), 1).sample(400)) == []
    ramp = np.linspace((1, 0), (2, 0), 1500)
    assert list_steps(ramp) == []


def test_a_force_that_is_its_reference_has_no_error_on_a_ramp_either():
    reference = np.linspace((0, 0), (2, -4), 2001)[1:]
    ticks = np.zeros((1, 1, 2000))
    recording = ExperimentRecording(
        reference[None], Command(ticks, ticks), Reading(ticks, ticks, ticks, reference[None, None])
    )
    np.testing.assert_allclose(score(recording).error, 0, atol=1e-9)
    recording = recording._replace(reference=reference[None] + [0.3, 0])
    np.testing.assert_allclose(score(recording).error[0, 0], [0.3, 0], atol=1e-9)
