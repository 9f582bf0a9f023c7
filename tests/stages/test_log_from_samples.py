import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import DeviceError
from softfin.rig.machine import Sample, Target
from softfin.stages.live import log_from_samples

ROWS = 100


def angle(time):
    return np.sin(3 * (time - 50))


def force(time):
    return np.cos(2 * (time - 50))


def samples(jitter=None, delay=0.02, count=ROWS + 20):
    jitter = np.zeros(count) if jitter is None else jitter
    times = 50 + 0.01 * np.arange(count) + jitter
    return [
        Sample(
            float(t),
            float(angle(t)),
            0.0,
            None,
            None,
            float(t - delay),
            (float(force(t - delay)), -float(force(t - delay)), 0.0, 0.0, 0.0, 0.0),
            (),
        )
        for t in times
    ]


def issued(*commands):
    return [(time, Target(value, 1.5)) for time, value in commands]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 0.04))
def test_both_devices_come_out_on_one_grid_whatever_jitter_and_filter(seed, delay):
    jitter = np.random.default_rng(seed).uniform(0, 0.004, ROWS + 20)
    jitter[0] = 0
    log = log_from_samples(samples(jitter, delay), issued((49.995, 0.3)), ROWS)
    grid = 50 + 0.01 * np.arange(ROWS)
    np.testing.assert_allclose(log.reading.angle, angle(grid), atol=5e-4)
    after = round(delay * 100) + 2
    np.testing.assert_allclose(log.reading.force[after:, 0], force(grid)[after:], atol=5e-4)
    np.testing.assert_allclose(log.reading.force[:, 1], -log.reading.force[:, 0], atol=1e-6)
    np.testing.assert_allclose(log.reading.time, 0.01 * np.arange(1, ROWS + 1))


def test_each_row_has_the_command_in_force():
    log = log_from_samples(samples(), issued((49.995, 0.3), (50.495, -0.4)), ROWS)
    np.testing.assert_array_equal(log.command.angle[:50], np.float32(0.3))
    np.testing.assert_array_equal(log.command.angle[50:], np.float32(-0.4))
    assert set(log.command.velocity.tolist()) == {1.5}


def test_a_reading_that_comes_twice_counts_once():
    twice = [one for sample in samples() for one in (sample, sample)]
    once = log_from_samples(samples(), issued((49.9, 0.3)), ROWS)
    np.testing.assert_array_equal(
        log_from_samples(twice, issued((49.9, 0.3)), ROWS).reading.force, once.reading.force
    )


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            lambda all_: all_[:40] + all_[48:],
            r"no angle for 90 ms at 0\.39 s of the log \(limit 50 ms\); .* --resume",
        ),
        (lambda all_: all_[: ROWS - 5], "no angle"),
        (lambda all_: all_[:ROWS], "no force"),
        (lambda all_: [s._replace(force_time=min(s.force_time, 50.3)) for s in all_], "no force"),
        (lambda all_: [s._replace(force_time=s.force_time + 0.2) for s in all_], "no force"),
    ],
)
def test_a_gap_is_an_error_and_not_bridged(fault, words):
    with pytest.raises(DeviceError, match=words):
        log_from_samples(fault(samples()), issued((49.9, 0.3)), ROWS)


def test_a_wider_gap_may_be_allowed():
    with_gap = samples()[:40] + samples()[48:]
    assert log_from_samples(with_gap, issued((49.9, 0.3)), ROWS, gap_s=0.2).reading.angle.shape == (
        ROWS,
    )


def test_the_rest_of_the_wrench_current_and_voltage_become_channels():
    def loaded(sample):
        x, y, *_ = sample.wrench
        level = sample.force_time - 50
        return sample._replace(
            wrench=(x, y, 1 + level, 2 + level, 0.0, 4 + level),
            current=sample.time - 49,
            voltage=sample.time - 38,
        )

    log = log_from_samples(list(map(loaded, samples())), issued((49.9, 0.3)), ROWS)
    grid = 0.01 * np.arange(ROWS)
    # A sensor that does not measure a load reports it as zero.
    starts = {"current_a": 1, "force_z_n": 1, "torque_nm": 4, "torque_x_nm": 2, "voltage_v": 12}
    assert sorted(log.channels) == sorted(starts)
    after = slice(4, None)
    for name, start in starts.items():
        assert log.channels[name].dtype == np.float32
        np.testing.assert_allclose(log.channels[name][after], start + grid[after], atol=1e-4)


@pytest.mark.parametrize("quantity", ["current", "voltage"])
def test_a_current_or_voltage_that_is_not_always_measured_is_left_out(quantity):
    some = [one._replace(**{quantity: 0.1 if k else None}) for k, one in enumerate(samples())]
    assert log_from_samples(some, issued((49.9, 0.3)), ROWS).channels == {}
