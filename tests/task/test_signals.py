import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.task.signals import Recorded, step

SIGNALS = [
    step((1, -1), (2, 0), 1),
    Recorded(time_s=(0, 0.5, 1), force_n=((1, -1), (2, 0), (3, 1))),
]


@pytest.mark.parametrize("signal", SIGNALS, ids=str)
def test_every_signal_is_float32_at_100_hz_and_comes_back_from_json(signal):
    series = signal.sample(300)
    assert series.shape == (300, 2)
    assert series.dtype == np.float32
    again = Recorded.build(signal.model_dump(mode="json"))
    assert again == signal
    assert hash(again) == hash(signal)


def test_a_step_happens_at_its_tick():
    series = step((1, -1), (2, 0), 0.29).sample(100)
    np.testing.assert_array_equal(series[28], [1, -1])
    np.testing.assert_array_equal(series[29], [2, 0])
    assert len(np.unique(series, axis=0)) == 2


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
        (Recorded, {"time_s": [0], "force_n": [[1, float("nan")]]}, "finite number"),
    ],
)
def test_signals_that_make_no_sense_are_refused(kind, signal, words):
    with pytest.raises(ConfigurationError, match=words):
        kind.build(signal)


def test_signals_say_what_they_are():
    assert [str(signal) for signal in SIGNALS] == [
        "step (1, -1) to (2, 0) N at 1 s",
        "recorded, 3 rows over 1 s",
    ]
