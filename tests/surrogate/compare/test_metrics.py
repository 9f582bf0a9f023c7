import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.surrogate.compare.metrics import DTW_BAND, SKIPPED, dtw_scores, series_scores, table_one
from softfin.surrogate.streaming.follow import follow
from softfin.surrogate.streaming.member import parameters, single
from tests.surrogate.streaming import small as streaming


def warped(a, b, band, cost):
    """The textbook's table: least sum of costs over monotone paths in the band, and the steps of that path."""
    best = {(-1, -1): (0.0, 0)}
    for i in range(len(a)):
        for j in range(max(0, i - band + 1), min(len(b), i + band)):
            before = [best[p] for p in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if p in best]
            least, steps = min(before)
            best[i, j] = (least + cost(a[i] - b[j]), steps + 1)
    return best[len(a) - 1, len(b) - 1]


@pytest.mark.parametrize("n", [30, 160])
def test_the_distances_are_those_of_their_definitions(n):
    random = np.random.default_rng(n)
    a, b = random.normal(size=(2, n)).cumsum(axis=1)
    (squared, steps), (absolute, _) = (warped(a, b, DTW_BAND, cost) for cost in (np.square, np.abs))
    scores = dtw_scores(a, b)
    assert steps > n
    assert scores["dtw_raw"] == pytest.approx(np.sqrt(squared))
    assert scores["dtw_path"] == pytest.approx(np.sqrt(squared) / steps)
    assert scores["dtw_rms"] == pytest.approx(np.sqrt(squared / n))
    assert scores["dtw_mae"] == pytest.approx(absolute / n)


def test_distances_scale_with_their_series():
    a, b = np.random.default_rng(0).normal(size=(2, 200)).cumsum(axis=1)
    for one, other in zip(dtw_scores(a, b).values(), dtw_scores(0.25 * a, 0.25 * b).values(), strict=True):
        assert other == pytest.approx(0.25 * one)


def test_equal_series_have_no_distance():
    series = np.sin(np.arange(50.0))[:, None]
    assert set(series_scores(series, series).values()) == {0.0}


def test_table_one_of_a_streaming_surrogate_scores_both_nets_over_all_members():
    plant, logs = streaming.surrogate(), [streaming.recorded(250, seed) for seed in range(2)]
    table = table_one(plant, logs)
    assert set(table) == {"drive", "force_measured", "force_free_running"}
    drive, force = (parameters(net) for net in (plant.members.drive, plant.members.force))
    assert [row["parameters"] for row in table.values()] == [drive, force, force]
    assert [row["window"] for row in table.values()] == [None] * 3

    def rmse(predicted, measured):
        return np.mean(np.sqrt(np.mean((predicted - measured)[SKIPPED:] ** 2, axis=0)))

    angle, free, given = [], [], []
    for log, said in zip(logs, follow(plant.members, logs), strict=True):
        reading = log.reading
        angle.append(rmse(said.angle.mean(axis=0)[:, None], reading.angle[:, None]))
        free.append(rmse(said.force.mean(axis=0), reading.force))
        alone = [streaming.forces_of(single(plant.members.force, index), reading).force for index in range(2)]
        given.append(rmse(np.concatenate([reading.force[:1], np.mean(alone, axis=0)]), reading.force))
    for row, expected in zip(table.values(), (angle, given, free), strict=True):
        assert row["physical"]["rmse"] == pytest.approx(np.mean(expected), rel=1e-4)
    # One range for both logs: its width is what scales.
    width = np.ptp(np.concatenate([log.reading.angle for log in logs]))
    assert table["drive"]["scaled"]["rmse"] == pytest.approx(table["drive"]["physical"]["rmse"] / width, rel=1e-3)


def test_test_logs_whose_command_never_changes_are_scored():
    log = streaming.recorded(250)
    steady = log._replace(command=log.command._replace(velocity=np.full(250, 2, np.float32)))
    assert np.isfinite(table_one(streaming.surrogate(), [steady])["drive"]["scaled"]["rmse"])


def test_test_logs_in_which_nothing_is_measured_are_refused():
    log = streaming.recorded(250)
    still = log._replace(reading=log.reading._replace(force=abs(log.reading.force) * np.float32([1, 0])))
    with pytest.raises(LogError, match="column force_y_n is 0 in every row of the test logs: nothing can be scored"):
        table_one(streaming.surrogate(), [still])
