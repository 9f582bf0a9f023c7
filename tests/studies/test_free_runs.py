import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.free_runs import free_run, plan_segments, run_from_rest, score_segments, take

from softfin.core.errors import LogError
from softfin.core.plant import roll
from softfin.core.quantities import Log, Reading
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate
from tests.plants import AnalyticFin
from tests.surrogate import small


def valid_rows(log, begin, end):
    return Log(*jax.tree.map(lambda x: x[begin:end], log))


def test_segments_lie_end_to_end_in_each_log():
    assert plan_segments([100, 65], ticks=20, first=12) == [
        *((0, row) for row in (12, 32, 52, 72)),
        *((1, row) for row in (12, 32)),
    ]


def test_a_log_shorter_than_the_horizon_is_an_error():
    with pytest.raises(LogError, match="test log 1: 111 rows"):
        plan_segments([500, 111], ticks=100, first=12)
    assert plan_segments([112], ticks=100, first=12) == [(0, 12)]


def test_segments_in_batches_are_those_rolled_one_by_one(monkeypatch):
    monkeypatch.setattr("studies.free_runs.BATCH", 3)
    plant = small.surrogate()
    logs = [small.log(rows=150, seed=1), small.log(rows=90, seed=2)]
    segments = plan_segments([150, 90], ticks=25, first=20)
    # Seven segments in batches of three: the last one is padded.
    run = free_run(plant, logs, segments, ticks=25)
    assert run.half_widths is None
    assert run.reading.force.shape == (7, 25, 2)
    for index, (log, row) in enumerate(segments):
        commands = jax.tree.map(jnp.asarray, valid_rows(logs[log], row - 1, row + 24).command)
        _, alone = roll(plant, plant.warm(valid_rows(logs[log], 0, row)), commands)
        for one, other in zip(alone, run.reading, strict=True):
            np.testing.assert_allclose(one, other[index], rtol=1e-4, atol=1e-4)


def test_a_plant_from_rest_repeats_its_own_logs_of_any_length():
    fin = AnalyticFin(noise_n=0.0)
    keys = list(jax.random.split(jax.random.key(0), 2))
    simulated = list(simulate([fin] * 2, keys, 400, ExcitationConfig(), 2, lambda rows: None))
    logs = [simulated[0], valid_rows(simulated[1], 0, 250)]
    readings = run_from_rest(fin, logs, jax.random.key(5))
    for reading, log in zip(readings, logs, strict=True):
        assert reading.angle.shape == log.reading.angle.shape
        np.testing.assert_allclose(reading.angle, log.reading.angle, atol=1e-6)
        np.testing.assert_allclose(reading.force, log.reading.force, atol=0.05)


def reading(ticks=260):
    random = np.random.default_rng(ticks)
    time, angle, velocity = random.normal(size=(3, 3, ticks))
    return Reading(time, angle, velocity, random.normal(size=(3, ticks, 2)))


def test_a_constant_error_is_the_score_of_its_own_channel():
    measured = reading()
    predicted = measured._replace(
        angle=measured.angle + 0.1, force=measured.force + np.array([0.3, -0.5])
    )
    half_widths = np.broadcast_to([0.4, 0.2], (3, 61, 2))
    assert score_segments(measured, predicted, half_widths) == pytest.approx(
        {
            "angle_rmse_rad": 0.1,
            "force_x_rmse_n": 0.3,
            "force_y_rmse_n": 0.5,
            "mean_force_mae_n": 0.4,
            "mean_force_p95_n": 0.5,
            "coverage": 0.5,
            "coverage_x": 1.0,
            "coverage_y": 0.0,
        }
    )


def test_segments_shorter_than_the_window_have_no_mean_force():
    measured = reading(ticks=199)
    assert not any(name.startswith("mean") for name in score_segments(measured, measured))


def test_the_rows_that_are_taken_are_those_of_the_log():
    logs = [small.log(rows=60, seed=seed) for seed in range(2)]
    taken = take(logs, [(1, 7), (0, 30)], ticks=5)
    np.testing.assert_array_equal(
        taken.reading.force, [logs[1].reading.force[7:12], logs[0].reading.force[30:35]]
    )
