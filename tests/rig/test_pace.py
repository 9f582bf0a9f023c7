import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.pace import Pace
from tests.rig.machines import Hours


def test_ticks_are_ten_milliseconds_apart_and_none_is_late():
    hours = Hours()
    pace = Pace(hours)
    times = [(pace.wait(), hours.now)[1] for _ in range(100)]
    assert times == pytest.approx([100.01 + 0.01 * k for k in range(100)], abs=1e-6)
    assert pace.to_dict()["skipped_ticks"] == 0
    assert pace.to_dict()["late_max_ms"] < 0.001


def test_a_late_tick_does_not_move_the_next_ones():
    hours = Hours()
    pace = Pace(hours)
    pace.wait()
    hours.now += 0.014
    assert pace.wait() == pytest.approx(0.004, abs=1e-6)
    assert pace.wait() == pytest.approx(0.0, abs=1e-6)
    assert hours.now == pytest.approx(100.03, abs=1e-6)


@given(st.lists(st.floats(0, 0.3), min_size=1, max_size=30))
def test_whole_periods_that_passed_are_counted_and_not_made_up_for(pauses):
    hours = Hours()
    pace = Pace(hours)
    pace.start()
    for pause in pauses:
        hours.now += pause
        pace.wait()
        due = 100 + 0.01 * (pace.ticks + pace.skipped + 1)
        assert hours.now < due + 1e-6
    assert pace.ticks == len(pauses)


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=50))
def test_the_histogram_tells_quantiles_to_a_tenth_of_a_millisecond(lates):
    hours = Hours()
    pace = Pace(hours)
    seen = []
    for late in lates:
        pace.start()
        hours.now += 0.01 + late
        seen.append(pace.wait())
    seen.sort()
    for part in (0.5, 0.99):
        exact = next(value for index, value in enumerate(seen) if index + 1 >= part * len(seen))
        told = pace.to_dict()[f"late_p{part * 100:.0f}_ms"] / 1e3
        assert (exact - 1e-6 <= told <= exact + 1e-4 + 1e-6) or (
            exact > 0.0999 and told <= seen[-1]
        )


def test_a_pace_that_nobody_waited_for_has_no_lateness():
    assert Pace().to_dict() == {
        "ticks": 0,
        "skipped_ticks": 0,
        "late_p50_ms": 0.0,
        "late_p99_ms": 0.0,
        "late_max_ms": 0.0,
    }
