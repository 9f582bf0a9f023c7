import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import LogError
from softfin.core.plant import hold, roll
from softfin.core.quantities import Command
from softfin.surrogate.paper.network import Network
from softfin.surrogate.paper.surrogate import Surrogate, SurrogateState, windows
from softfin.testing import check_surrogate
from tests.surrogate import small


def test_the_papers_surrogate_meets_the_contract():
    check_surrogate(small.surrogate())


def test_windows_are_every_run_of_samples_oldest_first():
    series = jnp.arange(10.0).reshape(2, 5)
    expected = np.stack([np.asarray(series)[:, i : i + 3] for i in range(3)])
    np.testing.assert_array_equal(windows(series, 3), expected)


def test_holding_a_command_equals_issuing_it_every_tick():
    plant = small.surrogate()
    actions = Command(jnp.asarray([0.7, -1.2, 0.3, 0.9]), jnp.asarray([1.0, 2.5, 3.0, 1.5]))
    start = plant.init(jax.random.key(0))
    held_state, held = hold(plant, start, actions)
    each = jax.tree.map(
        lambda x: jnp.repeat(x, np.array([*PAPER_CLOCK.ticks, PAPER_CLOCK.ticks[0]])), actions
    )
    state, reading = roll(plant, start, each)
    for a, b in zip(held, reading, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)
    assert int(state.tick) == int(held_state.tick) == 133


@pytest.mark.parametrize("ticks", [33, 34])
def test_after_an_action_it_remembers_the_ticks_that_were_held(ticks):
    # Windows longer than an action, and a past in which no two samples are alike.
    window = 60
    nets = (
        Network.create(config.model_copy(update={"window": window}), jax.random.key(0))
        for config in (small.POSNET, small.FORCENET)
    )
    plant = Surrogate(*nets, small.scaling())
    past = SurrogateState(
        jnp.int32(0),
        jnp.linspace(-1, 1, 2 * window).reshape(2, window),
        jnp.linspace(-1, 1, window),
    )
    command = Command(jnp.float32(0.7), jnp.float32(2.0))
    held, _ = plant.hold_action(past, command, ticks, 34)
    expected, _ = plant.advance(past, command, ticks)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), held, expected)
    # What one tick more would leave behind is something else.
    more, _ = plant.advance(past, command, ticks + 1)
    assert np.abs(more.commands - expected.commands).max() > 1e-2


def test_the_plant_says_what_the_nets_say_of_the_windows_of_its_own_log():
    """Row k holds reading k and the command issued then, so window i .. i+w-1 predicts reading
    i+w."""
    plant = small.surrogate()
    log = small.log(rows=200)
    commands = jax.tree.map(jnp.asarray, log.command)
    _, reading = roll(plant, plant.init(jax.random.key(0)), commands)
    # The reading after command k stands in row k + 1.
    angle = np.concatenate([[0.0], reading.angle[:-1]]).astype(np.float32)
    own = log._replace(reading=log.reading._replace(angle=angle))
    np.testing.assert_allclose(plant.predict_angle(own), angle[small.WINDOW :], atol=1e-5)
    force = plant.predict_force(own, free_running=True)
    np.testing.assert_allclose(force, reading.force[small.WINDOW - 1 : -1], atol=1e-3)


def test_free_running_forces_follow_no_measured_angle_after_the_first_window():
    plant = small.surrogate()
    log = small.log(rows=100)
    angle = log.reading.angle.copy()
    angle[small.WINDOW :] += 0.5
    other = log._replace(reading=log.reading._replace(angle=angle))
    free, given = (
        np.abs(plant.predict_force(other, running) - plant.predict_force(log, running)).max()
        for running in (True, False)
    )
    assert free == 0
    assert given > 0.01


def test_velocity_is_the_change_of_the_angle():
    plant = small.surrogate()
    _, reading = plant.advance(
        plant.init(jax.random.key(0)), Command(jnp.float32(1), jnp.float32(2)), 20
    )
    np.testing.assert_allclose(
        reading.velocity[1:], np.diff(reading.angle) * 100, rtol=1e-3, atol=1e-3
    )
    assert float(reading.velocity[0]) == pytest.approx(
        float(reading.angle[0]) * 100, rel=1e-3, abs=1e-3
    )


def test_limits_are_the_range_of_the_training_commands():
    assert small.surrogate().limits == (-1.5, 1.5, 1.0, 3.0)


def test_gradients_go_through_a_stroke():
    plant = small.surrogate()

    def mean_force(angle):
        start = plant.init(jax.random.key(0))
        return plant.advance(start, Command(angle, jnp.float32(2)), 10)[1].force[:, 1].mean()

    at = jnp.float32(0.5)
    step = 1e-2
    measured = (mean_force(at + step) - mean_force(at - step)) / (2 * step)
    assert float(jax.grad(mean_force)(at)) == pytest.approx(float(measured), rel=0.02)


def test_warm_counts_on_from_the_time_of_the_last_row():
    plant = small.surrogate()
    log = small.log(rows=60)
    last = jax.tree.map(lambda x: jnp.asarray(x[-1]), log.command)
    _, reading = plant.advance(plant.warm(log), last, 1)
    assert float(reading.time[0]) == pytest.approx(0.60)
    # A Unix clock counts within its day.
    unix = log._replace(reading=log.reading._replace(time=1.7e9 + np.arange(60) / 100))
    _, reading = plant.advance(plant.warm(unix), last, 1)
    assert float(reading.time[0]) == pytest.approx(1.7e9 % 86400 + 0.60, abs=0.01)


def test_only_the_last_rows_of_a_history_matter():
    plant = small.surrogate()
    log = small.log(rows=100)
    long = plant.warm(log)
    short = plant.warm(jax.tree.map(lambda x: x[-plant.memory :], log))
    assert all(np.array_equal(a, b) for a, b in zip(long, short, strict=True))
    with pytest.raises(LogError, match="history: 11 rows"):
        plant.warm(jax.tree.map(lambda x: x[:11], log))


def test_parameters_are_the_leaves_of_both_networks():
    plant = small.surrogate()
    networks = (plant.posnet, plant.forcenet)
    assert plant.parameters() == sum(array.size for array in jax.tree.leaves(networks))
    assert (plant.model, plant.memory) == ("paper", small.WINDOW)
