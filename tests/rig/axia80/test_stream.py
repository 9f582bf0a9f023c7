import os
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.rig.axia80.stream import Arrival, SequenceCounter, StreamClock

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 5_000


def taken(*pairs):
    counter = SequenceCounter()
    return counter, [counter.take(rdt % 2**32, ft % 2**32) for rdt, ft in pairs]


def places(found):
    return [place for _, place in found]


def test_an_even_stream_has_no_gaps():
    counter, found = taken(*((k, 8 * k) for k in range(1, 2000)))
    assert (counter.lost, counter.late, counter.duplicates, counter.streams, counter.restarts) == (0, 0, 0, 1, 0)
    assert places(found) == list(range(1, 2000))


def test_a_gap_is_counted_and_leaves_its_places_free():
    counter, found = taken((1, 8), (2, 16), (6, 48))
    assert counter.lost == 3
    assert places(found) == [1, 2, 6]


def test_a_late_record_is_not_lost_after_all():
    counter, found = taken((1, 8), (3, 24), (2, 16), (4, 32))
    assert (counter.lost, counter.late) == (0, 1)
    assert found[2] == (Arrival.LATE, 2)


def test_a_doubled_record_is_counted_even_long_after():
    counter, found = taken(*((k, 8 * k) for k in (1, 2, 3, 3, 4, 1)))
    assert counter.duplicates == 2
    assert found[3] == (Arrival.DUPLICATE, 3)
    assert found[5] == (Arrival.DUPLICATE, 1)


def test_both_numbers_roll_over_without_a_gap():
    counter, found = taken(*((2**32 - 3 + k, 2**32 - 20 + 8 * k) for k in range(8)))
    assert (counter.lost, counter.streams, counter.restarts) == (0, 1, 0)
    assert places(found) == list(range(1, 9))


def test_a_stream_that_was_asked_for_anew_is_no_restart():
    counter, _ = taken((1, 800), (2, 808))
    counter.begin()
    assert counter.take(1, 8000) == (Arrival.NEW_STREAM, 3)
    assert (counter.streams, counter.restarts, counter.lost) == (2, 0, 0)


def test_a_sensor_that_was_switched_off_and_on_is_noticed():
    counter, _ = taken((1, 800), (2, 808))
    counter.begin()
    assert counter.take(1, 8) == (Arrival.NEW_STREAM, 3)
    assert (counter.streams, counter.restarts) == (2, 1)


def test_a_stream_that_somebody_else_asked_for_is_noticed():
    counter, found = taken((5000, 40_000), (5001, 40_008), (1, 40_016), (2, 40_024))
    assert [arrival for arrival, _ in found[2:]] == [Arrival.NEW_STREAM, Arrival.NEXT]
    assert counter.restarts == 0


def test_a_restart_early_in_a_short_stream_is_noticed():
    counter, found = taken((1, 800), (2, 808), (3, 816), (1, 8), (2, 16))
    assert [arrival for arrival, _ in found[3:]] == [Arrival.NEW_STREAM, Arrival.NEXT]
    assert counter.restarts == 1


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.booleans(), min_size=2, max_size=300),
    st.integers(0, 2**32 - 1),
    st.randoms(use_true_random=False),
)
def test_every_record_is_counted_once_whatever_the_network_does(start, kept, ft, draw):
    sent = [k for k, there in enumerate(kept) if there or k in (0, len(kept) - 1)]
    doubled = [k for k in sent if draw.random() < 0.2]
    # Nothing overtakes the first, else it would not be known what is missing before it.
    arriving = [sent[0], *sorted(sent[1:] + doubled, key=lambda k: k + draw.uniform(0, 20))]
    counter, found = taken(*((start + k, ft + 8 * k) for k in arriving))
    assert counter.lost == len(kept) - len(sent)
    assert counter.duplicates == len(doubled)
    assert counter.streams == 1
    assert counter.restarts == 0
    fresh = [place for arrival, place in found if arrival is not Arrival.DUPLICATE]
    assert sorted(fresh) == [k + 1 for k in sent]


def test_any_numbers_are_counted_and_none_stops_the_count():
    draw = random.Random(6)
    counter = SequenceCounter()
    edges = (0, 1, 2, 1023, 1024, 1025, 2**31 - 1, 2**31, 2**32 - 1)
    for _ in range(CASES):
        arrival, _ = counter.take(draw.choice((*edges, draw.randrange(2**32))), draw.choice((*edges, 7)))
        assert isinstance(arrival, Arrival)
    assert len(counter._recent) <= 1024


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


def test_another_stream_keeps_the_rate_of_the_first():
    clock = StreamClock(1000.0)
    streamed(clock, 976.0, 1)
    clock.begin()
    assert clock.measured_s == 0
    clock.stamp(5, 200.0)
    assert clock.time_of(5) == 200.0
    assert clock.rate_hz == pytest.approx(976)
