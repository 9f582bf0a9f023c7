import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import CommandError, LogError
from softfin.core.plant import roll
from softfin.core.quantities import Log
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate
from softfin.surrogate.compare.scores import free_run, plan_segments, run_from_rest, take
from tests.plants import AnalyticFin, PlainFin
from tests.surrogate import small


def valid_rows(log, begin, end):
    return Log(*jax.tree.map(lambda x: x[begin:end], log))


def test_a_warm_free_running_surrogate_predicts_what_its_nets_do_over_the_log():
    plant = small.surrogate()
    log = small.log(rows=200)
    start = small.WINDOW
    _, reading = roll(
        plant,
        plant.warm(valid_rows(log, 0, start)),
        jax.tree.map(jnp.asarray, valid_rows(log, start - 1, -1)[0]),
    )
    np.testing.assert_allclose(reading.angle, plant.predict_angle(log), atol=1e-5)
    np.testing.assert_allclose(
        reading.force, plant.predict_force(log, free_running=True), atol=1e-5
    )


def test_warm_counts_on_from_the_time_of_the_last_row():
    plant = small.surrogate()
    log = small.log(rows=60)
    _, reading = plant.advance(
        plant.warm(valid_rows(log, 0, 50)),
        jax.tree.map(lambda x: jnp.asarray(x[49]), log.command),
        1,
    )
    assert float(reading.time[0]) == pytest.approx(float(log.reading.time[50]))


def test_warm_takes_a_unix_clock_and_counts_within_its_day():
    plant = small.surrogate()
    log = small.log(rows=60)
    unix = log._replace(reading=log.reading._replace(time=1.7e9 + np.arange(60) / 100))
    _, reading = plant.advance(
        plant.warm(unix), jax.tree.map(lambda x: jnp.asarray(x[-1]), log.command), 1
    )
    assert float(reading.time[0]) == pytest.approx(1.7e9 % 86400 + 0.60, abs=0.01)


def test_only_the_last_rows_of_a_history_matter():
    plant = small.surrogate()
    log = small.log(rows=100)
    long = plant.warm(log)
    short = plant.warm(valid_rows(log, 100 - plant.memory, 100))
    assert all(np.array_equal(a, b) for a, b in zip(long, short, strict=True))
    with pytest.raises(LogError, match="history: 11 rows; this surrogate needs 12 rows to warm up"):
        plant.warm(valid_rows(log, 0, 11))


def test_parameters_are_the_leaves_of_both_nets():
    plant = small.surrogate()
    nets = (plant.posnet, plant.forcenet)
    assert plant.parameters() == sum(array.size for array in jax.tree.leaves(nets))
    assert (plant.model, plant.memory) == ("paper", small.WINDOW)


def test_segments_lie_end_to_end_and_whole_in_each_log():
    assert plan_segments([100, 65], ticks=20, first=12) == [
        *((0, row) for row in (12, 32, 52, 72)),
        *((1, row) for row in (12, 32)),
    ]


def test_a_log_shorter_than_the_horizon_is_named_with_what_it_needs():
    with pytest.raises(
        LogError,
        match=r"test log 1: 111 rows; the warm-up of 12 rows and a horizon of 1 s need 112; .*--hor",
    ):
        plan_segments([500, 111], ticks=100, first=12)
    assert plan_segments([112], ticks=100, first=12) == [(0, 12)]


def test_segments_in_batches_are_those_rolled_one_by_one():
    plant = small.surrogate()
    logs = [small.log(rows=150, seed=1), small.log(rows=90, seed=2)]
    where = plan_segments([150, 90], ticks=25, first=20)
    # Eight segments in batches of at most three: the last one is filled up.
    reading, members = free_run(plant, logs, where, ticks=25)
    assert members is None
    assert reading.force.shape == (len(where), 25, 2) == (7, 25, 2)
    for index, (log, row) in enumerate(where):
        commands = jax.tree.map(jnp.asarray, valid_rows(logs[log], row - 1, row + 24).command)
        _, alone = roll(plant, plant.warm(valid_rows(logs[log], 0, row)), commands)
        for one, other in zip(alone, reading, strict=True):
            np.testing.assert_allclose(one, other[index], rtol=1e-4, atol=1e-4)


def test_rows_that_are_taken_are_those_of_the_log():
    logs = [small.log(rows=60, seed=seed) for seed in range(2)]
    taken = take(logs, [(1, 7), (0, 30)], ticks=5)
    np.testing.assert_array_equal(
        taken.reading.force, [logs[1].reading.force[7:12], logs[0].reading.force[30:35]]
    )
    np.testing.assert_array_equal(
        taken.command.angle, [logs[1].command.angle[7:12], logs[0].command.angle[30:35]]
    )


@pytest.mark.parametrize("fin", [AnalyticFin(noise_n=0.0), PlainFin()])
def test_a_plant_from_rest_repeats_its_own_logs_whatever_their_lengths(fin):
    keys = list(jax.random.split(jax.random.key(0), 2))
    whole = list(simulate([fin] * 2, keys, 400, ExcitationConfig(), 2, lambda rows: None))
    logs = [whole[0], valid_rows(whole[1], 0, 250)]
    readings = run_from_rest(fin, logs, jax.random.key(5))
    for reading, log in zip(readings, logs, strict=True):
        assert reading.angle.shape == log.reading.angle.shape
        np.testing.assert_allclose(reading.angle, log.reading.angle, atol=1e-6)
        np.testing.assert_allclose(reading.force, log.reading.force, atol=0.05)


def test_a_floor_that_does_not_take_the_commands_of_the_logs_is_an_error():
    log = small.log(rows=50)
    fast = log._replace(command=log.command._replace(velocity=log.command.velocity + 5))
    with pytest.raises(CommandError, match="command velocity"):
        run_from_rest(AnalyticFin(), [fast], jax.random.key(0))
