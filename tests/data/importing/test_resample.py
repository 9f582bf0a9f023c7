import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.data.importing.clocks import held_command, interpolated

FAST = np.arange(0, 5, 0.001)
GRID = np.arange(0.5, 4.5, 0.01)


def wave(time, hz):
    return np.sin(2 * np.pi * hz * time)


@pytest.mark.parametrize("hz", [1, 3, 10, 20])
def test_what_a_fin_does_passes_the_filter_without_delay(hz):
    np.testing.assert_allclose(interpolated(FAST, wave(FAST, hz), GRID), wave(GRID, hz), atol=0.01)


@pytest.mark.parametrize("hz", [60, 80, 120, 190])
def test_what_100_hz_cannot_show_is_gone_and_not_folded_back(hz):
    assert np.abs(wave(GRID, hz)).max() > 0.5
    assert np.abs(interpolated(FAST, wave(FAST, hz), GRID)).max() < 0.02


def test_a_source_of_100_hz_or_slower_is_interpolated_alone():
    time = np.arange(0, 5, 0.02)
    values = np.random.default_rng(0).normal(size=len(time))
    np.testing.assert_array_equal(interpolated(time, values, time[3:9]), values[3:9])
    np.testing.assert_allclose(
        interpolated(time, values, time[3:9] + 0.01), (values[3:9] + values[4:10]) / 2
    )


def test_a_constant_stays_what_it_is_up_to_the_ends():
    np.testing.assert_allclose(
        interpolated(FAST, np.full(len(FAST), 3.0), np.arange(0, 4.99, 0.01)), 3.0
    )


def test_a_fast_series_shorter_than_the_filter_is_its_mean():
    time = np.arange(0, 0.05, 0.001)
    np.testing.assert_allclose(interpolated(time, time, np.array([0.01, 0.02])), time.mean())


@settings(max_examples=50)
@given(
    st.lists(st.floats(0.001, 0.5), min_size=2, max_size=30),
    st.lists(st.floats(0, 1), min_size=1, max_size=30),
)
def test_a_held_command_is_the_last_that_was_issued(steps, places):
    time = np.cumsum(steps)
    values = np.arange(len(time), dtype=float)
    grid = np.sort(time[0] + np.array(places) * (time[-1] - time[0]))
    for at, value in zip(grid, held_command(time, values, grid), strict=True):
        assert value == max(i for i in range(len(time)) if time[i] <= at + 1e-6)
