import numpy as np
import pytest

from softfin.rig.filter import AntiAlias, design

RATES = [
    (500.0, 30.0),
    (1000.0, 30.0),
    (1000.0, 10.0),
    (1000.0, 40.0),
    (976.0, 35.0),
    (7812.0, 30.0),
]


def gain(taps, rate_hz, frequency_hz):
    places = np.arange(len(taps))
    return np.abs(np.exp(-2j * np.pi * np.outer(frequency_hz, places) / rate_hz) @ taps)


def filled(anti_alias, signal):
    for value in signal:
        anti_alias.put(np.array([value]))
    return anti_alias


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), RATES)
def test_what_beats_slowly_passes_within_one_percent(rate_hz, cutoff_hz):
    band = np.linspace(0, cutoff_hz - min(50 - cutoff_hz, 2 / 3 * cutoff_hz), 200)
    assert np.abs(gain(design(rate_hz, cutoff_hz), rate_hz, band) - 1).max() < 0.01


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), RATES)
def test_above_half_the_rate_of_the_log_less_than_a_hundred_and_fiftieth_is_left(
    rate_hz, cutoff_hz
):
    band = np.linspace(50, rate_hz / 2, 2000)
    assert gain(design(rate_hz, cutoff_hz), rate_hz, band).max() < 1 / 150


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), RATES)
def test_the_gain_is_a_half_at_the_cutoff(rate_hz, cutoff_hz):
    assert gain(design(rate_hz, cutoff_hz), rate_hz, np.array([cutoff_hz]))[0] == pytest.approx(
        0.5, abs=0.02
    )


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), RATES)
def test_a_straight_line_comes_out_later_by_exactly_the_delay(rate_hz, cutoff_hz):
    anti_alias = AntiAlias(rate_hz, cutoff_hz, 1)
    filled(anti_alias, np.arange(1.0, 4 * len(anti_alias.taps)))
    assert anti_alias.output()[0] == pytest.approx(anti_alias.newest - anti_alias.delay, abs=1e-6)


def test_a_step_settles_within_the_length_of_the_filter_and_hardly_overshoots():
    anti_alias = AntiAlias(1000.0, 30.0, 1)
    length = len(anti_alias.taps)
    filled(anti_alias, np.zeros(length))
    out = []
    for _ in range(length):
        anti_alias.put(np.ones(1))
        out.append(anti_alias.output()[0])
    assert out[-1] == pytest.approx(1)
    assert -0.12 < min(out) < max(out) < 1.12
    assert out[anti_alias.delay] == pytest.approx(0.5, abs=0.05)


def test_a_wave_of_the_fins_is_kept_and_one_that_would_alias_is_not():
    time = np.arange(1000) / 1000
    slow = np.sin(2 * np.pi * 3 * time)
    fast = np.sin(2 * np.pi * 103 * time)
    anti_alias = AntiAlias(1000.0, 30.0, 1)
    for place, value in enumerate(slow + fast, 1):
        anti_alias.put(np.array([value]))
        if place in (850, 900, 1000):
            assert anti_alias.output()[0] == pytest.approx(
                slow[place - 1 - anti_alias.delay], abs=0.02
            )


def test_nothing_comes_out_before_the_filter_is_full():
    anti_alias = AntiAlias(1000.0, 30.0, 1)
    length = len(anti_alias.taps)
    filled(anti_alias, np.ones(length - 1))
    assert anti_alias.output() is None
    anti_alias.put(np.ones(1))
    assert anti_alias.output() is not None


def test_a_short_gap_is_bridged_by_a_line():
    anti_alias = AntiAlias(1000.0, 30.0, 1)
    for place in range(1, 300):
        if place % 50 not in (1, 2, 3):
            anti_alias.put(np.array([float(place)]), place - anti_alias.newest - 1)
    assert anti_alias.output()[0] == pytest.approx(299 - anti_alias.delay)


def test_a_long_gap_empties_the_filter():
    anti_alias = filled(AntiAlias(1000.0, 30.0, 1), np.ones(200))
    anti_alias.put(np.ones(1), 10)
    assert anti_alias.output() is not None
    anti_alias.put(np.ones(1), 11)
    assert anti_alias.output() is None
