import os
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.rig.axia80.stream import SequenceCounter, StreamClock

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 5_000


COUNTS = ("lost", "late", "streams", "restarts")


@pytest.mark.parametrize(
    ("numbers", "places", "counts"),
    [
        ([(k, 8 * k) for k in range(1, 200)], list(range(1, 200)), (0, 0, 1, 0)),
        ([(1, 8), (2, 16), (6, 48)], [1, 2, 6], (3, 0, 1, 0)),
        ([(1, 8), (3, 24), (2, 16), (4, 32)], [1, 3, None, 4], (1, 1, 1, 0)),
        ([(1, 8), (2, 16), (2, 16), (3, 24), (1, 8)], [1, 2, None, 3, None], (0, 2, 1, 0)),
        ([((2**32 - 3 + k) % 2**32, (2**32 - 20 + 8 * k) % 2**32) for k in range(8)], [*range(1, 9)], (0, 0, 1, 0)),
        ([(1, 800), (2, 808), "begin", (1, 8000)], [1, 2, 3], (0, 0, 2, 0)),
        ([(1, 800), (2, 808), "begin", (1, 8)], [1, 2, 3], (0, 0, 2, 1)),
        ([(5000, 40_000), (1, 40_016), (2, 40_024)], [1, 2, 3], (0, 0, 2, 0)),
        ([(5000, 40_000), (1, 8), (2, 16)], [1, 2, 3], (0, 0, 2, 1)),
    ],
    ids=["even", "gap", "overtaken", "doubled", "roll-over", "asked anew", "switched off and on", "asked by another",
         "restarted unasked"],
)  # fmt: skip
def test_every_record_has_its_place_and_what_is_missing_is_counted(numbers, places, counts):
    counter, found = SequenceCounter(), []
    for pair in numbers:
        if pair == "begin":
            counter.begin()
        else:
            found.append(counter.take(*pair))
    assert [taken and taken[0] for taken in found] == places
    assert sum(taken is not None and taken[1] for taken in found) == counter.streams
    assert tuple(getattr(counter, name) for name in COUNTS) == counts


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=2, max_size=300), st.integers(0, 2**32 - 1))
def test_what_is_lost_and_what_is_doubled_add_up(start, kept, ft):
    sent = [k for k, there in enumerate(kept) if there or k in (0, len(kept) - 1)]
    counter = SequenceCounter()
    places = [counter.take((start + k) % 2**32, (ft + 8 * k) % 2**32) for k in sent for _ in range(2)]
    assert (counter.lost, counter.late, counter.streams) == (len(kept) - len(sent), len(sent), 1)
    assert [taken[0] for taken in places if taken] == [k + 1 for k in sent]


def test_any_numbers_are_counted_and_none_stops_the_count():
    draw, counter = random.Random(6), SequenceCounter()
    edges = (0, 1, 2, 63, 64, 65, 2**31 - 1, 2**31, 2**32 - 1)
    places = [0]
    for _ in range(CASES):
        taken = counter.take(draw.choice((*edges, draw.randrange(2**32))), draw.choice((*edges, 7)))
        if taken is not None:
            places.append(taken[0])
    assert places == sorted(set(places))


def streamed(clock, rate_hz, seconds, late=lambda tick: 0.0, began=100.0):
    for tick in range(round(seconds * 100)):
        place = round(tick * rate_hz / 100)
        clock.stamp(place, began + place / rate_hz + late(tick))
    return place


def test_the_rate_of_the_stream_is_measured():
    clock = StreamClock(1000.0)
    streamed(clock, 976.0, 1)
    assert clock.rate_hz == pytest.approx(976)
    assert clock.measured_s == pytest.approx(0.99, abs=0.01)


def test_a_packet_that_was_held_up_moves_no_time():
    clock = StreamClock(1000.0)
    newest = streamed(clock, 1000.0, 1, late=lambda tick: 0.02 if tick > 95 else 0.0)
    assert clock.time_of(newest) == pytest.approx(100 + newest / 1000, abs=1e-3)


def test_a_stream_that_stays_late_is_followed():
    clock = StreamClock(1000.0)
    newest = streamed(clock, 1000.0, 5, late=lambda tick: 0.02 if tick > 300 else 0.0)
    assert clock.time_of(newest) == pytest.approx(100.02 + newest / 1000, abs=1e-3)


def test_a_pause_is_not_bridged():
    clock = StreamClock(1000.0)
    newest = streamed(clock, 1000.0, 1)
    clock.stamp(newest + 1, 105.0)
    assert clock.time_of(newest + 1) == 105.0


def test_before_its_rate_is_measured_a_stream_has_the_one_expected():
    clock = StreamClock(976.0)
    assert clock.measured_s == 0
    clock.stamp(5, 200.0)
    assert clock.time_of(5) == 200.0
    assert clock.rate_hz == 976.0
