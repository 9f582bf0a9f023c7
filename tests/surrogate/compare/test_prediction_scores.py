import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate.compare.prediction_scores import coverage, judge, ranges

RANDOM = np.random.default_rng(0)


def log(stretches=3, ticks=260):
    shape = (stretches, ticks)
    command = Command(np.zeros(shape, np.float32), np.ones(shape, np.float32))
    angle, velocity, time = RANDOM.normal(size=(3, *shape)).astype(np.float32)
    return Log(command, Reading(time, angle, velocity, RANDOM.normal(size=(*shape, 2)).astype(np.float32)))


def off(reading, angle=0.0, force=(0.0, 0.0)):
    return reading._replace(angle=reading.angle + np.float32(angle), force=reading.force + np.float32(force))


MEASURED = log()
SPANS = {"angle": 2.0, "force_x": 5.0, "force_y": 10.0}


def test_a_perfect_prediction_has_no_error():
    scores = judge(MEASURED, MEASURED.reading, SPANS).scores
    assert {scores.pop(f"{name}_r2") for name in SPANS} == {1.0}
    assert set(scores.values()) == {0.0}


def test_a_channel_that_never_moves_has_no_r2_and_does_not_stop_a_comparison():
    still = MEASURED._replace(reading=MEASURED.reading._replace(angle=np.zeros_like(MEASURED.reading.angle)))
    scores = judge(still, off(still.reading, angle=0.1), SPANS).scores
    assert scores["angle_r2"] == -np.inf
    assert scores["angle_rmse_rad"] == pytest.approx(0.1)


def test_a_constant_error_shows_in_its_own_channel_with_its_size():
    scores = judge(MEASURED, off(MEASURED.reading, angle=0.1, force=(0.3, -0.5)), SPANS).scores
    expected = {
        "angle_rmse_rad": 0.1,
        "angle_mae_rad": 0.1,
        "force_x_rmse_n": 0.3,
        "force_y_rmse_n": 0.5,
        "force_mae_n": 0.4,
        "angle_r2": 1 - 0.01 / MEASURED.reading.angle.var(),
        "force_x_r2": 1 - 0.09 / MEASURED.reading.force[..., 0].var(),
        "mean_force_x_mae_n": 0.3,
        "mean_force_y_mae_n": 0.5,
        "mean_force_mae_n": 0.4,
        "mean_force_p95_n": 0.5,
        "mean_force_worst_n": 0.5,
    }
    assert {name: scores[name] for name in expected} == pytest.approx(expected, rel=1e-4)


def test_errors_are_pooled_over_stretches_not_averaged():
    predicted = MEASURED.reading._replace(angle=MEASURED.reading.angle + np.float32([[0.0], [0.0], [0.3]]))
    assert judge(MEASURED, predicted, SPANS).scores["angle_rmse_rad"] == pytest.approx(0.3 / np.sqrt(3), rel=1e-4)


def test_the_scaled_distances_are_of_series_divided_by_their_ranges():
    scores = judge(
        MEASURED, MEASURED.reading._replace(force=log().reading.force, angle=log().reading.angle), SPANS
    ).scores
    assert scores["angle_dtw_raw_scaled"] == pytest.approx(scores["angle_dtw_raw_rad"] / 2)
    only_y = off(MEASURED.reading)
    only_y.force[..., 1] = log().reading.force[..., 1]
    scores = judge(MEASURED, only_y, SPANS).scores
    for kind in ("raw", "path", "rms", "mae"):
        assert scores[f"force_dtw_{kind}_scaled"] == pytest.approx(scores[f"force_dtw_{kind}_n"] / 10) != 0


def test_the_mean_force_is_over_every_run_of_200_samples():
    judged = judge(MEASURED, log().reading, SPANS)
    assert judged.mean_errors.shape == (3, 61, 2)
    short = judge(log(ticks=199), log(ticks=199).reading, SPANS)
    assert short.mean_errors is None
    assert not any(name.startswith("mean_force") for name in short.scores)


def test_coverage_is_the_share_of_errors_inside_what_was_stated():
    errors = np.array([-1.0, -0.4, 0.0, 0.4]).reshape(1, 2, 2)
    assert coverage(np.full((1, 2, 2), 0.5), errors) == 0.75
    predicted = off(MEASURED.reading, force=(0.3, -0.5))
    members = np.stack([predicted.force - 1, predicted.force + 1])

    def half_width(means):
        np.testing.assert_allclose(means[1] - means[0], np.full((3, 61, 2), 2.0), rtol=1e-5)
        return np.broadcast_to([0.4, 0.2], (3, 61, 2))

    judged = judge(MEASURED, predicted, SPANS, members, half_width)
    assert judged.scores["coverage"] == 0.5
    assert judged.scores["half_width_n"] == pytest.approx(0.3)


def test_ranges_are_over_all_logs_and_a_dead_channel_is_named():
    one, other = (log(stretches=1) for _ in range(2))
    flat = [Log(*(type(part)(*(x[0] for x in part)) for part in each)) for each in (one, other)]
    both = np.concatenate([each.reading.force[:, 1] for each in flat])
    assert ranges(flat)["force_y"] == pytest.approx(both.max() - both.min())
    dead = [each._replace(reading=each.reading._replace(angle=np.zeros(260, np.float32))) for each in flat]
    with pytest.raises(LogError, match="angle is the same in every row"):
        ranges(dead)
