import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate.channels import SKIPPED
from softfin.surrogate.compare.scores import (
    DTW_BAND,
    dtw_mae,
    measured_ranges,
    score_segments,
    table_one,
)
from softfin.surrogate.streaming.ensemble import parameters, single
from tests.surrogate import small
from tests.surrogate.streaming import small as streaming


def warped(a, b, band):
    """The textbook's table: least sum of absolute differences over monotone paths in the band."""
    best = {(-1, -1): 0.0}
    for i in range(len(a)):
        for j in range(max(0, i - band + 1), min(len(b), i + band)):
            before = [best[p] for p in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if p in best]
            best[i, j] = min(before) + abs(a[i] - b[j])
    return best[len(a) - 1, len(b) - 1]


@pytest.mark.parametrize("n", [30, 160])
def test_the_distance_is_that_of_its_definition(n):
    a, b = np.random.default_rng(n).normal(size=(2, n)).cumsum(axis=1)
    assert dtw_mae(a, b) == pytest.approx(warped(a, b, DTW_BAND) / n)
    assert dtw_mae(0.25 * a, 0.25 * b) == pytest.approx(0.25 * dtw_mae(a, b))
    assert dtw_mae(a, a) == 0


def test_the_distance_forgives_a_lag():
    time = np.arange(1000)
    measured, predicted = (np.sin((time - lag) / 50) for lag in (0, 5))
    assert 0 < dtw_mae(predicted, measured) < 0.2 * np.mean(np.abs(predicted - measured))


def test_table_one_scores_each_net_in_both_units():
    table = table_one(small.surrogate(), [small.log(rows=300, seed=s) for s in (1, 2)])
    assert set(table) == {"posnet", "forcenet_measured", "forcenet_free_running"}
    assert table["posnet"]["parameters"] == small.POSNET.parameters()
    # An angle range of 3.2 rad is scaled onto 0 .. 1.
    assert table["posnet"]["physical"]["rmse"] == pytest.approx(
        3.2 * table["posnet"]["scaled"]["rmse"], rel=1e-4
    )


def test_table_one_of_a_streaming_surrogate_scores_both_nets_over_all_members():
    plant = streaming.surrogate()
    logs = [streaming.recorded(250, seed) for seed in range(2)]
    table = table_one(plant, logs)
    assert set(table) == {"drive", "force_measured", "force_free_running"}
    drive, force = (parameters(net) for net in (plant.members.drive, plant.members.force))
    assert [row["parameters"] for row in table.values()] == [drive, force, force]
    assert [row["window"] for row in table.values()] == [None] * 3

    def rmse(predicted, measured):
        return np.mean(np.sqrt(np.mean((predicted - measured)[SKIPPED:] ** 2, axis=0)))

    angle = []
    free = []
    given = []
    for log, said in zip(logs, streaming.predict_logs(plant.members, logs), strict=True):
        reading = log.reading
        angle.append(rmse(said.motion.angle.mean(axis=0)[:, None], reading.angle[:, None]))
        free.append(rmse(said.force.mean(axis=0), reading.force))
        alone = [
            streaming.forces_of(single(plant.members.force, index), reading) for index in range(2)
        ]
        given.append(
            rmse(np.concatenate([reading.force[:1], np.mean(alone, axis=0)]), reading.force)
        )
    for row, expected in zip(table.values(), (angle, given, free), strict=True):
        assert row["physical"]["rmse"] == pytest.approx(np.mean(expected), rel=1e-4)
    # One range for both logs: its width is what scales.
    width = np.ptp(np.concatenate([log.reading.angle for log in logs]))
    assert table["drive"]["scaled"]["rmse"] == pytest.approx(
        table["drive"]["physical"]["rmse"] / width, rel=1e-3
    )


def test_test_logs_whose_command_never_changes_are_scored():
    log = streaming.recorded(250)
    steady = log._replace(command=log.command._replace(velocity=np.full(250, 2, np.float32)))
    assert np.isfinite(table_one(streaming.surrogate(), [steady])["drive"]["scaled"]["rmse"])


def test_test_logs_in_which_nothing_is_measured_are_refused():
    log = streaming.recorded(250)
    still = log._replace(
        reading=log.reading._replace(force=abs(log.reading.force) * np.float32([1, 0]))
    )
    with pytest.raises(
        LogError,
        match="test logs: column force_y_n is 0 in every row, so its predictions cannot be scored",
    ):
        table_one(streaming.surrogate(), [still])


RANDOM = np.random.default_rng(0)


def log(segments=3, ticks=260):
    shape = (segments, ticks)
    command = Command(np.zeros(shape, np.float32), np.ones(shape, np.float32))
    angle, velocity, time = RANDOM.normal(size=(3, *shape)).astype(np.float32)
    return Log(
        command, Reading(time, angle, velocity, RANDOM.normal(size=(*shape, 2)).astype(np.float32))
    )


def off(reading, angle=0.0, force=(0.0, 0.0)):
    return reading._replace(
        angle=reading.angle + np.float32(angle), force=reading.force + np.float32(force)
    )


MEASURED = log()
SPANS = {"angle_rad": 2.0, "force_x_n": 5.0, "force_y_n": 10.0}


def test_a_perfect_prediction_has_no_error():
    scores = score_segments(MEASURED, MEASURED.reading, SPANS).scores
    assert {scores.pop(f"{name}_r2") for name in ("angle", "force_x", "force_y")} == {1.0}
    assert set(scores.values()) == {0.0}


def test_a_channel_that_never_moves_has_no_r2_and_does_not_stop_a_comparison():
    still = MEASURED._replace(
        reading=MEASURED.reading._replace(angle=np.zeros_like(MEASURED.reading.angle))
    )
    scores = score_segments(still, off(still.reading, angle=0.1), SPANS).scores
    assert scores["angle_r2"] == -np.inf
    assert scores["angle_rmse_rad"] == pytest.approx(0.1)


def test_a_constant_error_shows_in_its_own_channel_with_its_size():
    scores = score_segments(
        MEASURED, off(MEASURED.reading, angle=0.1, force=(0.3, -0.5)), SPANS
    ).scores
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


def test_errors_are_pooled_over_segments_not_averaged():
    predicted = MEASURED.reading._replace(
        angle=MEASURED.reading.angle + np.float32([[0.0], [0.0], [0.3]])
    )
    scores = score_segments(MEASURED, predicted, SPANS).scores
    assert scores["angle_rmse_rad"] == pytest.approx(0.3 / np.sqrt(3), rel=1e-4)


def test_the_scaled_distances_are_of_series_divided_by_their_ranges():
    scores = score_segments(
        MEASURED,
        MEASURED.reading._replace(force=log().reading.force, angle=log().reading.angle),
        SPANS,
    ).scores
    assert scores["angle_dtw_mae_scaled"] == pytest.approx(scores["angle_dtw_mae_rad"] / 2)
    only_y = off(MEASURED.reading)
    only_y.force[..., 1] = log().reading.force[..., 1]
    scores = score_segments(MEASURED, only_y, SPANS).scores
    assert scores["force_dtw_mae_scaled"] == pytest.approx(scores["force_dtw_mae_n"] / 10) != 0


def test_the_mean_force_is_over_every_run_of_200_samples():
    scored = score_segments(MEASURED, log().reading, SPANS)
    assert scored.mean_errors.shape == (3, 61, 2)
    short = score_segments(log(ticks=199), log(ticks=199).reading, SPANS)
    assert short.mean_errors is None
    assert not any(name.startswith("mean_force") for name in short.scores)


def test_coverage_is_the_share_of_errors_inside_what_was_stated():
    predicted = off(MEASURED.reading, force=(0.3, -0.5))
    scored = score_segments(MEASURED, predicted, SPANS, np.broadcast_to([0.4, 0.2], (3, 61, 2)))
    assert scored.scores["coverage"] == 0.5
    assert scored.scores["half_width_n"] == pytest.approx(0.3)


def test_ranges_are_over_all_logs_and_a_dead_channel_is_named():
    one, other = (log(segments=1) for _ in range(2))
    flat = [Log(*(type(part)(*(x[0] for x in part)) for part in each)) for each in (one, other)]
    both = np.concatenate([each.reading.force[:, 1] for each in flat])
    assert measured_ranges(flat)["force_y_n"] == pytest.approx(both.max() - both.min())
    dead = [
        each._replace(reading=each.reading._replace(angle=np.zeros(260, np.float32)))
        for each in flat
    ]
    with pytest.raises(LogError, match="column angle_rad is 0 in every row"):
        measured_ranges(dead)
