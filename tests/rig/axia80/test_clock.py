import socket
import struct

import pytest

from softfin.rig.axia80.clock import SO_TIMESTAMPNS, StreamClock, wall_stamp


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


def test_the_kernels_stamp_is_read_in_nanoseconds():
    kind = (socket.SOL_SOCKET, SO_TIMESTAMPNS)
    assert wall_stamp([(*kind, struct.pack("@ll", 17, 250_000_000))]) == 17.25
    assert wall_stamp([(0, 0, b"another"), (*kind, b"short")]) is None
    assert wall_stamp([]) is None
