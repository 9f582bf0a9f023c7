import pytest

from softfin.core.ticks import tick_at


@pytest.mark.parametrize(
    ("time_s", "tick"), [(0.01, 1), (12.344, 1234), (86_399.99, 8_639_999), (1.7e9, 8_000_000), (-0.5, 8_639_950)]
)
def test_ticks_are_counted_within_the_day_whenever_the_clock_began(time_s, tick):
    assert tick_at(time_s) == tick
