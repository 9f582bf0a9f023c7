import math
import os
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.emulation.clock import SimulatedClock
from softfin.emulation.network import SimulatedSocket
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.rdt import RdtRecord, encode_record
from softfin.rig.devices.axia80.stream import Arrival, ForceStream
from softfin.rig.stream_clock import StreamClock

CONFIG = Axia80Config(address="127.0.0.1", frame="x,y")

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 5_000


def received(numbers):
    """A stream that has received records of these numbers; their force along x is their place in
    the list."""
    stream = ForceStream(CONFIG, [1.0] * 6, SimulatedClock())
    stream.collected = []
    sent = [RdtRecord(number, 0, 0, (k, 0, 0, 0, 0, 0)) for k, number in enumerate(numbers)]
    arrivals = [Arrival(record, stream.taken) for record in sent]
    stream.client.drain = lambda: arrivals
    stream.take()
    return stream


@pytest.mark.parametrize(
    ("numbers", "newest", "lost", "late"),
    [
        (list(range(1, 200)), 199, 0, 0),
        ([1, 2, 6], 6, 3, 0),
        ([1, 3, 2, 4], 4, 1, 1),
        ([1, 2, 2, 3, 1], 3, 0, 2),
        ([(2**32 - 3 + k) % 2**32 for k in range(8)], 8, 0, 0),
    ],
    ids=["even", "gap", "overtaken", "doubled", "roll-over"],
)
def test_what_is_missing_late_or_doubled_is_counted(numbers, newest, lost, late):
    stream = received(numbers)
    assert (stream.filter.newest, stream.lost, stream.late) == (newest, lost, late)
    assert stream.records == len(numbers) == len(stream.collected) + late


def test_a_stream_that_is_requested_anew_begins_at_any_number():
    stream = received([700, 701])
    stream.request()
    stream.take()
    assert (stream.filter.newest, stream.lost, stream.late) == (4, 0, 0)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=2, max_size=300))
def test_what_is_lost_and_what_is_doubled_add_up(start, kept):
    sent = [k for k, there in enumerate(kept) if there or k in (0, len(kept) - 1)]
    stream = received([(start + k) % 2**32 for k in sent for _ in range(2)])
    assert (stream.lost, stream.late) == (len(kept) - len(sent), len(sent))
    assert [values[0] / 2 for values in stream.collected] == list(range(len(sent)))


def test_any_numbers_are_counted_and_none_stops_the_count():
    draw = random.Random(6)
    edges = (0, 1, 2, 63, 64, 65, 2**31 - 1, 2**31, 2**32 - 1)
    stream = received([draw.choice((*edges, draw.randrange(2**32))) for _ in range(CASES)])
    assert stream.records == CASES == len(stream.collected) + stream.late


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
    assert clock.estimate_time(newest) == pytest.approx(100 + newest / 1000, abs=1e-3)


def test_a_stream_that_stays_late_is_followed():
    clock = StreamClock(1000.0)
    newest = streamed(clock, 1000.0, 5, late=lambda tick: 0.02 if tick > 300 else 0.0)
    assert clock.estimate_time(newest) == pytest.approx(100.02 + newest / 1000, abs=1e-3)


def test_a_pause_is_not_bridged():
    clock = StreamClock(1000.0)
    newest = streamed(clock, 1000.0, 1)
    clock.stamp(newest + 1, 105.0)
    assert clock.estimate_time(newest + 1) == 105.0


def test_before_its_rate_is_measured_a_stream_has_the_one_expected():
    clock = StreamClock(976.0)
    assert clock.measured_s == 0
    clock.stamp(5, 200.0)
    assert clock.estimate_time(5) == 200.0
    assert clock.rate_hz == 976.0


def arrivals(numbers, began=100.0):
    return [
        Arrival(RdtRecord(n, 8 * n, 0, (k, 0, 0, 0, 0, 0)), began + k / 1000)
        for k, n in enumerate(numbers)
    ]


@pytest.mark.parametrize("jump", [1_000, 10**6, 10**9, -(10**9)])
def test_a_jump_of_the_numbers_does_not_spoil_the_rate(jump):
    clock = SimulatedClock()
    stream = ForceStream(CONFIG, [1.0] * 6, clock)
    numbers = [n if n < 1000 else (n + jump) % 2**32 for n in range(2000)]
    sent = arrivals(numbers, clock())
    for start in range(0, 2000, 10):
        stream.client.drain = lambda start=start: sent[start : start + 10]
        clock.sleep(0.01)
        stream.take()
    assert stream.times.rate_hz == pytest.approx(1000, rel=0.02)
    assert stream.lost == (jump if 0 < jump < 2**24 else 0)
    assert stream.reading().force_time == pytest.approx(clock() - stream.delay_s, abs=0.01)


def test_records_of_an_earlier_stream_do_not_stop_the_one_that_was_requested_anew():
    stream = received(range(5000, 5100))
    stream.request()
    late = [Arrival(RdtRecord(n, 0, 0, (0,) * 6), stream.taken) for n in (5100, 1, 2, 3)]
    stream.client.drain = lambda: late
    stream.take()
    assert stream.late == 0
    assert stream._sequence == 3


def test_what_came_before_a_new_request_is_not_joined_to_what_comes_after():
    stream = received(range(1, 101))
    assert stream.filter.full
    stream.request()
    assert not stream.filter.full


def test_any_datagrams_make_no_error_and_no_force_that_is_not_finite():
    clock = SimulatedClock()
    draw = random.Random(7)
    sensor = SimulatedSocket(clock, "127.0.0.1", 49152)
    stream = ForceStream(CONFIG, [1e-6] * 6, clock)
    stream.request()
    client = stream.client._socket.address
    number = 0
    readings = 0
    for _ in range(CASES):
        kind = draw.random()
        number = draw.randrange(2**32) if kind < 0.002 else number + 1
        record = RdtRecord(
            number % 2**32,
            draw.randrange(2**32),
            draw.randrange(2**32),
            tuple(draw.randrange(-(2**31), 2**31) for _ in range(6)),
        )
        datagram = encode_record(record) if kind < 0.95 else draw.randbytes(draw.randrange(100))
        sensor.sendto(datagram, client)
        if draw.random() < 0.1:
            clock.sleep(draw.choice((0.0, 0.001, 0.01, 0.5)))
            clock.wall_set_s = draw.choice((0.0, 0.0, 0.0, 1e9, -1e9))
            stream.take()
            stream.watch.lines()
            reading = stream.reading()
            if reading is not None:
                readings += 1
                assert all(map(math.isfinite, (*reading.wrench, *reading.peak, reading.force_time)))
                assert reading.force_time <= clock()
    assert readings > CASES / 100
    assert stream.client.refused > CASES / 100
