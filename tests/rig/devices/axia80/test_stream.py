import math
import os
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import DeviceError
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.network import SimulatedSocket
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.rdt import BUSY_BIT, RdtRecord, encode_record
from softfin.rig.devices.axia80.sensor import RdtSource, axia80_sensor
from softfin.rig.devices.axia80.stream import Arrival, RdtClient
from softfin.rig.stream_clock import StreamClock

CONFIG = Axia80Config(address="127.0.0.1", frame="x,y")

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 5_000


def arrivals(numbers, began):
    return [
        Arrival(RdtRecord(n, 8 * n % 2**32, 0, (k, 0, 0, 0, 0, 0)), began + k / 1000)
        for k, n in enumerate(numbers)
    ]


class Client:
    """Instead of an `RdtClient`: a test puts what has arrived."""

    refused = 0
    closed = True

    def __init__(self):
        self.arrivals = []

    def send(self, command):
        return True

    def drain(self):
        arrivals = self.arrivals
        self.arrivals = []
        return arrivals


def listening(clock):
    source = RdtSource(CONFIG, clock)
    source._client = Client()
    source._is_first_burst = False
    return source


def received(numbers):
    """A source that has received records of these numbers, and what it made of them; their force
    along x is their place in the list."""
    clock = SimulatedClock()
    source = listening(clock)
    sent = [RdtRecord(number, 0, 0, (k, 0, 0, 0, 0, 0)) for k, number in enumerate(numbers)]
    source._client.arrivals = [Arrival(record, clock()) for record in sent]
    return source, source.take()


@pytest.mark.parametrize(
    ("numbers", "missing", "late"),
    [
        (list(range(1, 200)), 0, 0),
        ([1, 2, 6], 3, 0),
        ([1, 3, 2, 4], 1, 1),
        ([1, 2, 2, 3, 1], 0, 2),
        ([(2**32 - 3 + k) % 2**32 for k in range(8)], 0, 0),
    ],
    ids=["even", "gap", "overtaken", "doubled", "roll-over"],
)
def test_what_is_missing_late_or_doubled_is_counted(numbers, missing, late):
    source, records = received(numbers)
    assert (source.counted["lost"], source.counted["late"]) == (missing, late)
    assert sum(record.missing for record in records) == missing
    assert source.counted["records"] == len(numbers) == len(records) + late


def test_the_first_burst_is_dropped_because_its_timestamps_may_be_too_new():
    source = listening(SimulatedClock())
    source._is_first_burst = True
    source._client.arrivals = arrivals(range(1, 30), source.clock())
    assert source.take() == []
    source._client.arrivals = arrivals(range(30, 40), source.clock())
    assert len(source.take()) == 10
    assert (source.counted["lost"], source.counted["records"]) == (0, 10)


def test_after_a_silence_the_stream_is_requested_again_and_begins_at_any_number():
    source, _ = received([50, 51])
    source.clock.sleep(0.2)
    assert source.take() == []
    record = RdtRecord(1, 0, 0, (0,) * 6)
    source._client.arrivals = [Arrival(record, source.clock())]
    ((_, missing, _),) = source.take()
    assert (missing, source.counted["lost"], source.counted["late"]) == (199, 0, 0)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=2, max_size=300))
def test_what_is_lost_and_what_is_doubled_add_up(start, kept):
    sent = [k for k, there in enumerate(kept) if there or k in (0, len(kept) - 1)]
    source, records = received([(start + k) % 2**32 for k in sent for _ in range(2)])
    assert (source.counted["lost"], source.counted["late"]) == (len(kept) - len(sent), len(sent))
    assert [record.wrench[0] / 2 for record in records] == list(range(len(sent)))


def test_any_numbers_are_counted_and_none_stops_the_count():
    draw = random.Random(6)
    edges = (0, 1, 2, 63, 64, 65, 2**31 - 1, 2**31, 2**32 - 1)
    source, records = received([draw.choice((*edges, draw.randrange(2**32))) for _ in range(CASES)])
    assert source.counted["records"] == CASES == len(records) + source.counted["late"]


def test_records_of_an_earlier_stream_do_not_stop_the_one_that_was_requested_anew():
    source, _ = received(range(5000, 5100))
    source._request()
    source._client.arrivals = [
        Arrival(RdtRecord(n, 0, 0, (0,) * 6), source.clock()) for n in (5100, 1, 2, 3)
    ]
    assert len(source.take()) == 4
    assert source.counted["late"] == 0


def counted(before, after):
    """Whether the sensor seems to have restarted between two values of its counter."""
    source = listening(SimulatedClock())
    source._client.arrivals = [
        Arrival(RdtRecord(number, samples % 2**32, 0, (0,) * 6), source.clock())
        for number, samples in enumerate((before, after))
    ]
    source.take()
    return "restarted" in "".join(source.complaints())


@pytest.mark.parametrize("before", [0, 10**6, 2**31 - 4000, 2**31 + 4000, 2**32 - 4000])
@pytest.mark.parametrize("step", [-40, 8, 8000, 10**6])
def test_a_counter_that_goes_on_or_rolls_over_is_no_restart(before, step):
    assert not counted(before, before + step)


@pytest.mark.parametrize("before", [10_000, 10**9, 2**31 + 10**6, 2**32 - 2**25])
def test_a_counter_that_begins_anew_is_a_restart(before):
    assert counted(before, 0)


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


@pytest.mark.parametrize("jump", [1_000, 10**6, 10**9, -(10**9)])
def test_a_jump_of_the_numbers_does_not_spoil_the_rate(jump, monkeypatch):
    clock = SimulatedClock()
    sensor = axia80_sensor(CONFIG, clock)
    source = sensor._source
    source._client = Client()
    source._is_first_burst = False
    sensor._is_open = True
    numbers = [n if n < 1000 else (n + jump) % 2**32 for n in range(2000)]
    sent = arrivals(numbers, clock())
    for start in range(0, 2000, 10):
        source._client.arrivals = sent[start : start + 10]
        clock.sleep(0.01)
        sensor.keep_up()
    assert sensor.times.rate_hz == pytest.approx(1000, rel=0.02)
    assert source.counted["lost"] == (jump if 0 < jump < 2**24 else 0)
    assert sensor.read().force_time == pytest.approx(clock() - sensor.delay_s, abs=0.01)


def test_any_datagrams_make_no_error_and_no_force_that_is_not_finite():
    clock = SimulatedClock()
    draw = random.Random(7)
    socket = SimulatedSocket(clock, "127.0.0.1", 49152)
    sensor = axia80_sensor(CONFIG, clock)
    source = sensor._source
    source._client = RdtClient("127.0.0.1", 49152, clock)
    source._scale = np.full(6, 1e-6)
    sensor._is_open = True
    client = source._client._socket.address
    number = 0
    readings = 0
    for _ in range(CASES):
        kind = draw.random()
        number = draw.randrange(2**32) if kind < 0.002 else number + 1
        record = RdtRecord(
            number % 2**32,
            draw.randrange(2**32),
            draw.randrange(2**32) & ~(draw.random() < 0.9) << BUSY_BIT,
            tuple(draw.randrange(-(2**31), 2**31) for _ in range(6)),
        )
        datagram = encode_record(record) if kind < 0.95 else draw.randbytes(draw.randrange(100))
        socket.sendto(datagram, client)
        if draw.random() < 0.1:
            clock.sleep(draw.choice((0.0, 0.001, 0.01, 0.5)))
            clock.wall_set_s = draw.choice((0.0, 0.0, 0.0, 1e9, -1e9))
            sensor.complaints()
            try:
                reading = sensor.read()
            except DeviceError:
                continue
            readings += 1
            assert all(map(math.isfinite, (*reading.wrench, *reading.peak, reading.force_time)))
            assert reading.force_time <= clock()
    assert readings > CASES / 100
    assert source._client.refused > CASES / 100
