import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.tank.sensor import IDEAL, Sensor, SensorConfig, mean_of_past

SAMPLES = 20_000


@jax.jit
def read(sensor, force, key):
    first, noise = jax.random.split(key)

    def sample(state, step):
        tick, force = step
        return sensor.read(state, force, jax.random.fold_in(noise, tick))

    return jax.lax.scan(sample, sensor.rest(first), (jnp.arange(len(force)), force))[1]


def record(config, force, seed=0):
    """Readings of a force, ``(samples, 2)``."""
    return np.asarray(read(Sensor(config), jnp.asarray(force, jnp.float32), jax.random.key(seed)))


def with_only(**imperfection):
    return SensorConfig(**{**IDEAL.model_dump(), **imperfection})


def test_an_ideal_sensor_reports_the_force():
    force = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    np.testing.assert_array_equal(record(IDEAL, force), force)


def test_the_filter_answers_a_step_with_its_time_constant():
    reading = record(with_only(filter_s=0.05), np.ones((50, 2)))
    expected = 1 - np.exp(-np.arange(1, 51) * 0.01 / 0.05)
    np.testing.assert_allclose(reading[:, 0], expected, rtol=1e-5)


def test_noise_is_white_and_of_its_standard_deviation():
    reading = record(with_only(noise_n=0.2), np.zeros((SAMPLES, 2)))
    np.testing.assert_allclose(reading.std(0), 0.2, rtol=0.03)
    assert np.abs(np.corrcoef(reading[1:, 0], reading[:-1, 0])[0, 1]) < 0.03
    assert np.abs(np.corrcoef(reading.T)[0, 1]) < 0.03


@pytest.mark.parametrize("zero_s", [0.0, 2.0])
@pytest.mark.parametrize("drift_n", [0.0, 0.05])
def test_the_noise_of_a_mean_is_what_many_sensors_measure(drift_n, zero_s):
    config = with_only(noise_n=0.2, drift_n=drift_n, drift_s=40.0, zero_s=zero_s)
    keys = jax.random.split(jax.random.key(3), 500)
    readings = jax.vmap(read, in_axes=(None, None, 0))(Sensor(config), jnp.zeros((1500, 2)), keys)
    measured = float(jnp.std(readings[:, -200:].mean(axis=1)))
    assert Sensor(config).mean_noise(200, 14.0) == pytest.approx(measured, rel=0.06)


def test_zeroing_is_what_a_mean_at_rest_would_be():
    """Against a sensor that is never zeroed and read at rest for 2 s, whose mean is then subtracted
    by hand."""
    with_drift = {"noise_n": 0.05, "drift_n": 0.05, "drift_s": 30.0}
    fins = 2000
    keys = jax.random.split(jax.random.key(3), fins)
    many = jax.vmap(read, in_axes=(None, None, 0))
    raw = many(Sensor(with_only(**with_drift, zero_s=0.0)), jnp.zeros((200, 2)), keys)
    by_hand = np.asarray(raw[:, -1] - raw.mean(axis=1))
    sensor = Sensor(with_only(**with_drift))
    zeroed = many(sensor, jnp.zeros((1, 2)), keys)[:, 0]
    assert np.asarray(raw[:, -1]).std() == pytest.approx(np.hypot(0.05, 0.05), rel=0.05)
    # The noise of one reading hides the error of the zero, so both are also compared without it.
    assert np.asarray(zeroed).std() == pytest.approx(by_hand.std(), rel=0.05)
    states = jax.vmap(sensor.rest)(keys)
    noiseless = Sensor(with_only(drift_n=0.05, drift_s=30.0, zero_s=0.0))
    quiet = many(noiseless, jnp.zeros((200, 2)), keys)
    moved = np.asarray(quiet[:, -1] - quiet.mean(axis=1)).var()
    expected = np.sqrt(moved + 0.05**2 / 200)
    assert np.asarray(states.zero - states.drift).std() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("drift_s", [0.5, 2.0, 30.0])
def test_the_zero_goes_with_the_drift_as_in_a_simulation_whatever_the_two_durations_are(drift_s):
    """An explicit walk over the 2 s at rest, whose end is the drift and whose mean is the zero."""
    rng = np.random.default_rng(0)
    fins = 20_000
    share = np.exp(-0.01 / drift_s)
    walk = np.empty((200, fins))
    walk[0] = rng.normal(size=fins)
    for tick in range(1, 200):
        walk[tick] = share * walk[tick - 1] + np.sqrt(1 - share**2) * rng.normal(size=fins)
    simulated = np.cov(walk[-1], walk.mean(axis=0))
    sensor = Sensor(with_only(drift_n=1.0, drift_s=drift_s, zero_s=2.0))
    states = jax.vmap(sensor.rest)(jax.random.split(jax.random.key(4), fins))
    drawn = np.cov(np.ravel(states.drift), np.ravel(states.zero))
    np.testing.assert_allclose(drawn, simulated, rtol=0.04, atol=0.02)
    error = np.ravel(states.zero - states.drift).var()
    assert error == pytest.approx((walk.mean(axis=0) - walk[-1]).var(), rel=0.04)


def test_the_mean_of_the_past_is_exact_for_short_and_long_times():
    for a in (1e-7, 1e-3, 0.0999, 0.1001, 1.0, 50.0):
        slope, spread = mean_of_past(jnp.float32(a))
        decay = -np.expm1(-a)
        # Below 0.01 the formula in double precision would cancel, too.
        exact = (2 * (a - decay) - decay**2) / a**2 if a > 0.01 else 2 * a / 3 - a**2 / 2
        assert float(slope) == pytest.approx(decay / a, rel=1e-4)
        assert float(spread) == pytest.approx(exact, rel=2e-4)


def test_the_electronics_saturate_before_the_zero_is_subtracted():
    sensor = Sensor(with_only(range_n=1.0))
    state = sensor.rest(jax.random.key(0))._replace(zero=jnp.array([0.4, -0.4]))
    _, reading = sensor.read(state, jnp.array([5.0, -5.0]), jax.random.key(1))
    np.testing.assert_allclose(reading, [0.6, -0.6], rtol=1e-6)


def test_drift_is_slow_and_of_its_standard_deviation_from_the_start():
    config = with_only(drift_n=0.3, drift_s=5.0)
    starts = jax.vmap(Sensor(config).rest)(jax.random.split(jax.random.key(0), 500)).drift
    assert np.asarray(starts).std() == pytest.approx(0.3, rel=0.1)
    reading = record(config.model_copy(update={"zero_s": 0.0}), np.zeros((SAMPLES, 2)))
    assert reading.std() == pytest.approx(0.3, rel=0.35)
    assert np.diff(reading, axis=0).std() == pytest.approx(0.3 * np.sqrt(2 * 0.01 / 5.0), rel=0.05)


def test_resolution_rounds_and_lets_gradients_through():
    config = with_only(resolution_n=0.5)
    np.testing.assert_allclose(record(config, np.array([[0.7, -0.7]])), [[0.5, -0.5]])
    sensor = Sensor(config)
    key = jax.random.key(0)
    jacobian = jax.jacobian(lambda force: sensor.read(sensor.rest(key), force, key)[1])(
        jnp.array([0.7, -0.7])
    )
    np.testing.assert_allclose(jacobian, np.eye(2), atol=1e-6)


def test_a_sensor_turned_by_a_right_angle_reports_x_as_minus_y_and_y_as_x():
    reading = record(with_only(misalignment_rad=np.pi / 2), np.eye(2))
    np.testing.assert_allclose(reading, [[0.0, -1.0], [1.0, 0.0]], atol=1e-6)


def test_readings_end_at_the_range():
    reading = record(with_only(range_n=2.0), np.array([[3.0, -1.0], [-3.0, 2.5]]))
    np.testing.assert_allclose(reading, [[2.0, -1.0], [-2.0, 2.0]])
