"""The client on a real socket of the loopback: what the kernel keeps while nobody reads, and its
stamps.

Judged by contents and stamps alone: how long the computer takes for anything does not matter.
"""

import itertools
import socket
import sys
import time

import numpy as np
import pytest

from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.devices.axia80 import stream
from softfin.rig.devices.axia80.rdt import RdtCommand, RdtRecord, encode_record
from softfin.rig.devices.axia80.stream import RdtClient
from tests.patience import HANG_S

HAS_STAMPS = sys.platform.startswith("linux")


class SetClock(Computer):
    """The real one, with a date that the test sets."""

    ahead_s = 0.0

    def wall(self) -> float:
        return time.time() + self.ahead_s


class BusyClock(Computer):
    """The real one, in a process that is held up now and then while it reads the date."""

    interruptions = 0

    def wall(self) -> float:
        if self.interruptions:
            self.interruptions -= 1
            time.sleep(4 * stream.DATE_STEP_S)
        return time.time()


class Pair:
    """A client with a receive buffer of so many bytes, and a socket in the sensor's place."""

    def __init__(self, room_bytes, clock=COMPUTER):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(HANG_S)
        self.socket.bind(("127.0.0.1", 0))
        self.client = RdtClient("127.0.0.1", self.socket.getsockname()[1], clock)
        self.client._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room_bytes)
        self.client.send(RdtCommand.START)
        _, self.address = self.socket.recvfrom(100)
        self.sent_at = {}
        self._numbers = itertools.count(1)
        if HAS_STAMPS:
            self._await_stamps()

    def _await_stamps(self):
        """Linux turns timestamps on some time after it is asked to; until then, a record that was
        not read at once has the time at which it was read."""
        end = time.monotonic() + HANG_S
        while time.monotonic() < end:
            (number,) = self.send(1)
            time.sleep(0.02)
            arrivals = drained(self.client)
            if arrivals and arrivals[-1].time <= self.sent_at[number][1] + 0.01:
                return
        pytest.fail("the kernel does not stamp records")

    def send(self, count):
        """Send so many records; returns their numbers."""
        numbers = list(itertools.islice(self._numbers, count))
        for number in numbers:
            before = time.monotonic()
            self.socket.sendto(
                encode_record(RdtRecord(number, 8 * number, 0, (number,) * 6)), self.address
            )
            self.sent_at[number] = before, time.monotonic()
        return numbers

    def close(self):
        self.client.close()
        self.socket.close()


@pytest.fixture(params=[64 * 1024, 212_992, 4 * 1024 * 1024])
def pair(request):
    pair = Pair(request.param)
    yield pair
    pair.close()


def drained(client):
    arrivals = []
    while some := client.drain():
        arrivals += some
    return arrivals


@pytest.mark.skipif(not HAS_STAMPS, reason="the kernel's stamps are used on Linux alone")
def test_each_record_has_the_time_at_which_it_was_sent_however_late_it_is_taken(pair):
    assert pair.client.drain() == []
    first = pair.send(50)
    # Nobody reads meanwhile; however long this takes, it is in no stamp.
    time.sleep(0.3)
    second = pair.send(50)
    arrivals = drained(pair.client)
    assert [arrival.record.rdt_sequence for arrival in arrivals] == first + second
    for record, arrived in arrivals:
        before, after = pair.sent_at[record.rdt_sequence]
        # The date and the monotonic clock are read one after the other, and a busy computer may
        # come in between.
        assert before - 0.05 <= arrived <= after + 0.05


def test_a_full_buffer_keeps_the_oldest_and_a_drain_is_bounded(pair):
    assert pair.client.drain() == []
    sent = pair.send(12_000)
    first = pair.client.drain()
    rest = drained(pair.client)
    numbers = [arrival.record.rdt_sequence for arrival in first + rest]
    assert numbers == sent[: len(numbers)]
    assert len(first) == min(len(numbers), stream.MAX_DATAGRAMS)
    # Each drain measures the offset between the clocks anew; records of a sensor come 1 ms apart.
    times = np.array([arrival.time for arrival in first + rest])
    assert np.diff(times).min() > -stream.DATE_STEP_S / 10


@pytest.mark.skipif(not HAS_STAMPS, reason="the kernel's stamps are used on Linux alone")
def test_a_busy_computer_does_not_look_like_a_date_that_was_set():
    clock = BusyClock()
    pair = Pair(212_992, clock)
    try:
        assert pair.client.drain() == []
        # Without their stamps the records would count as this much older.
        time.sleep(0.1)
        pair.send(20)
        clock.interruptions = 2
        arrivals = pair.client.drain()
        assert clock.interruptions == 0
        assert len(arrivals) == 20
        for record, arrived in arrivals:
            before, after = pair.sent_at[record.rdt_sequence]
            assert before - 0.05 <= arrived <= after + 0.05
    finally:
        pair.close()


def test_readings_that_are_never_close_together_make_records_older_not_newer():
    clock = BusyClock()
    pair = Pair(212_992, clock)
    try:
        assert pair.client.drain() == []
        empty_by = time.monotonic()
        pair.send(20)
        clock.interruptions = stream.OFFSET_TRIES
        arrivals = pair.client.drain()
        assert clock.interruptions == 0
        assert all(arrival.time <= empty_by for arrival in arrivals)
    finally:
        pair.close()


@pytest.mark.parametrize("step_s", [-1e6, -1.0, 1.0, 1e6])
def test_a_date_that_is_set_moves_no_record_out_of_the_time_in_which_it_came(step_s):
    clock = SetClock()
    pair = Pair(212_992, clock)
    try:
        for _ in range(3):
            empty_at = time.monotonic()
            assert pair.client.drain() == []
            pair.send(20)
            clock.ahead_s += step_s
            arrivals = pair.client.drain()
            now = time.monotonic()
            assert len(arrivals) == 20
            assert all(empty_at <= arrival.time <= now for arrival in arrivals)
    finally:
        pair.close()


def test_without_stamps_a_backlog_counts_as_old_as_it_can_be(pair, monkeypatch):
    pair.client._has_stamps = False
    assert pair.client.drain() == []
    empty_by = time.monotonic()
    pair.send(20)
    time.sleep(2 * stream.UNREAD_S)
    arrivals = pair.client.drain()
    assert len(arrivals) == 20
    assert all(arrival.time <= empty_by for arrival in arrivals)
