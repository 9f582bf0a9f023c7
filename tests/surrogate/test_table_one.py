import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.surrogate.channels import SKIPPED
from softfin.surrogate.streaming.ensemble import parameters, single
from softfin.surrogate.table_one import DTW_BAND, dtw_mae, measured_ranges, table_one
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
    row = table["posnet"]
    assert row["parameters"] == small.POSNET.parameters()
    assert (row["title"], row["unit"]) == ("PosNet, commands to angle", "rad")
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
        nets = [single(plant.members.force, index) for index in range(2)]
        mean = np.mean([streaming.forces_of(net, reading) for net in nets], axis=0)
        given.append(rmse(np.concatenate([reading.force[:1], mean]), reading.force))
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
    force = abs(log.reading.force) * np.float32([1, 0])
    still = log._replace(reading=log.reading._replace(force=force))
    with pytest.raises(LogError, match="test logs: column force_y_n is 0"):
        table_one(streaming.surrogate(), [still])


def test_ranges_are_over_all_logs_and_a_dead_channel_is_named():
    logs = [streaming.recorded(250, seed) for seed in range(2)]
    both = np.concatenate([log.reading.force[:, 1] for log in logs])
    assert measured_ranges(logs)["force_y_n"] == pytest.approx(both.max() - both.min())
    dead = [
        log._replace(reading=log.reading._replace(angle=np.zeros(250, np.float32))) for log in logs
    ]
    with pytest.raises(LogError, match="column angle_rad is 0"):
        measured_ranges(dead)
