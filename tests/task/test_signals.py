import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.task.signals import Ramp, Recorded, Sinusoid, Step

SIGNALS = [
    Step(start_n=(1, -1), to_n=(2, 0), at_s=1),
    Ramp(start_n=(1, -1), to_n=(2, 0), begin_s=1, end_s=2),
    Sinusoid(centre_n=(2, 0), amplitude_n=(0.5, -1), period_s=4),
    Recorded(time_s=(0, 0.5, 1), force_n=((1, -1), (2, 0), (3, 1))),
]


@pytest.mark.parametrize("signal", SIGNALS, ids=lambda signal: signal.kind)
def test_every_signal_is_float32_at_100_hz_and_comes_back_from_json(signal):
    series = signal.sample(300)
    assert series.shape == (300, 2)
    assert series.dtype == np.float32
    again = type(signal).build(signal.model_dump(mode="json"))
    assert again == signal
    assert hash(again) == hash(signal)


def test_a_step_happens_at_its_tick():
    series = Step(start_n=(1, -1), to_n=(2, 0), at_s=0.29).sample(100)
    np.testing.assert_array_equal(series[28], [1, -1])
    np.testing.assert_array_equal(series[29], [2, 0])
    assert len(np.unique(series, axis=0)) == 2


def test_a_ramp_is_straight_between_its_ends():
    series = Ramp(start_n=(1, -1), to_n=(2, 1), begin_s=1, end_s=3).sample(400)
    np.testing.assert_array_equal(series[:101], np.tile([1, -1], (101, 1)))
    np.testing.assert_allclose(series[200], [1.5, 0], atol=1e-6)
    np.testing.assert_allclose(
        np.diff(series[100:301], axis=0), np.tile([0.005, 0.01], (200, 1)), atol=1e-6
    )
    np.testing.assert_array_equal(series[300:], np.tile([2, 1], (100, 1)))


def test_a_sine_goes_about_its_centre_with_its_amplitudes_and_period():
    series = Sinusoid(centre_n=(2, 0), amplitude_n=(0.5, -1), period_s=4).sample(800)
    np.testing.assert_allclose(
        series[[0, 100, 200, 300]], [[2, 0], [2.5, -1], [2, 0], [1.5, 1]], atol=1e-6
    )
    np.testing.assert_allclose(series[:400], series[400:], atol=1e-5)
    np.testing.assert_allclose(series.mean(axis=0), [2, 0], atol=1e-6)


def test_a_recorded_force_is_held_until_the_next_one_and_the_last_for_good():
    series = Recorded(time_s=(0, 0.1 + 0.2, 0.555), force_n=((1, -1), (2, 0), (3, 1))).sample(100)
    np.testing.assert_array_equal(series[[0, 29, 30, 55, 56, 99], 0], [1, 1, 2, 2, 3, 3])


@pytest.mark.parametrize(
    ("times", "seconds"), [((0.0,), 0), ((0, 5), 10), ((0, 2.5, 3.75), 5), ((0, 9.98, 9.99), 10)]
)
def test_the_last_force_takes_as_long_as_the_one_before(times, seconds):
    assert Recorded(time_s=times, force_n=((1, 1),) * len(times)).seconds == seconds


@pytest.mark.parametrize(
    ("kind", "signal", "words"),
    [
        (Recorded, {"time_s": [0, 2, 2], "force_n": [[1, 1]] * 3}, "time 2 s after 2 s"),
        (Recorded, {"time_s": [1, 2], "force_n": [[1, 1]] * 2}, "first time is 1 s"),
        (Recorded, {"time_s": [0, 2], "force_n": [[1, 1]]}, "2 times and 1 forces"),
        (Ramp, {"start_n": [1, 1], "to_n": [1, 2], "begin_s": 3, "end_s": 3}, "end_s"),
        (Step, {"start_n": [1, float("nan")], "to_n": [1, 1]}, "start_n"),
    ],
)
def test_signals_that_make_no_sense_are_refused(kind, signal, words):
    with pytest.raises(ConfigurationError, match=words):
        kind.build(signal)


def test_signals_say_what_they_are():
    assert [str(signal) for signal in SIGNALS] == [
        "step (1, -1) to (2, 0) N at 1 s",
        "ramp (1, -1) to (2, 0) N from 1 s to 2 s",
        "sine about (2, 0) N, amplitude (0.5, -1) N, of 4 s",
        "recorded, 3 rows over 1 s",
    ]
