import contextlib
import itertools

import pynetft
import pytest

from softfin.emulation import network as simulated_network
from softfin.emulation.axia80 import ADC_RATE_HZ, LOOPBACK, EmulatedAxia80
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.network import SimulatedSocket
from softfin.rig.computer import COMPUTER
from softfin.rig.devices.axia80.rdt import (
    BUSY,
    OVER_RANGE,
    RdtCommand,
    decode_record,
    encode_request,
)
from tests.patience import HANG_S, wait_until
from tests.rig.still_fin import StillFin


@contextlib.contextmanager
def emulated(*wrench, clock=None, **options):
    clock = clock or SimulatedClock()
    sensor = EmulatedAxia80(StillFin(*wrench), clock=clock, **options)
    sensor.clock = clock
    try:
        yield sensor
    finally:
        sensor.close()


@contextlib.contextmanager
def client_of(sensor):
    yield Client(sensor)


class Client:
    """Of its own, not softfin's."""

    def __init__(self, sensor):
        self.clock = sensor.clock
        self.sensor = (LOOPBACK, sensor.rdt_port)
        self.socket = SimulatedSocket(sensor.clock, LOOPBACK, timeout=5.0)

    def send(self, data):
        self.socket.sendto(data, self.sensor)

    def recv(self):
        return self.socket.recvfrom(4096)[0]


def asked(client, order, datagrams=1):
    client.send(encode_request(order))
    return [decode_record(client.recv()) for _ in range(datagrams)]


def silent(client):
    client.clock.sleep(0.01)
    client.socket.timeout = 0.0
    with contextlib.suppress(BlockingIOError):
        while True:
            client.socket.recvfrom(4096)
    client.socket.timeout = 1.0
    try:
        client.socket.recvfrom(4096)
    except BlockingIOError:
        return True
    return False


def test_records_are_numbered_from_one_and_contain_the_load():
    with emulated(1, 2, 3, 0.4, 0.5, 0.6) as sensor, client_of(sensor) as client:
        records = asked(client, RdtCommand.START, 5)
        assert [record.rdt_sequence for record in records] == [1, 2, 3, 4, 5]
        # A count of noise.
        assert records[0].counts == pytest.approx(
            (1_000_000, 2_000_000, 3_000_000, 400_000, 500_000, 600_000), abs=1
        )


def test_stop_ends_the_stream_and_a_new_request_begins_another():
    with emulated() as sensor, client_of(sensor) as client:
        (before,) = asked(client, RdtCommand.START)
        client.send(encode_request(RdtCommand.STOP))
        assert silent(client)
        (after,) = asked(client, RdtCommand.START)
        assert after.rdt_sequence == 1
        assert after.ft_sequence > before.ft_sequence


def test_the_stream_goes_to_whoever_asked_last():
    with emulated() as sensor, client_of(sensor) as first, client_of(sensor) as second:
        asked(first, RdtCommand.START)
        asked(second, RdtCommand.START)
        assert silent(first)
        assert second.recv()


def test_nonsense_is_not_answered():
    with emulated() as sensor, client_of(sensor) as client:
        for nonsense in (b"", b"GET / HTTP/1.0", bytes(8), bytes.fromhex("1234004100000000")):
            client.send(nonsense)
        assert silent(client)
        assert asked(client, RdtCommand.START)


def test_a_force_beyond_its_range_is_cut_and_flagged():
    with emulated(600, 0, 0, 0, 0, 0) as sensor, client_of(sensor) as client:
        sensor.busy_s = 0.0
        (record,) = asked(client, RdtCommand.START)
        assert record.counts[0] == pytest.approx(500_000_000, abs=1)
        assert record.status == OVER_RANGE


def test_after_power_up_it_is_busy_for_a_moment_and_its_count_starts_at_zero():
    with emulated() as sensor, client_of(sensor) as client:
        sensor.reboot(0.0)
        (first,) = asked(client, RdtCommand.START)
        assert first.ft_sequence < 20
        assert first.status == BUSY
        client.clock.sleep(0.3)
        assert asked(client, RdtCommand.START)[0].status == BUSY
        records = [decode_record(client.recv()) for _ in range(300)]
        assert records[-1].status == 0


def test_its_count_goes_on_while_nobody_asks():
    with emulated() as sensor, client_of(sensor) as client:
        (before,) = asked(client, RdtCommand.START)
        began_s = client.clock()
        client.send(encode_request(RdtCommand.STOP))
        client.clock.sleep(10.0)
        assert silent(client)
        (after,) = asked(client, RdtCommand.START)
        elapsed_s = client.clock() - began_s
        assert after.ft_sequence - before.ft_sequence == pytest.approx(
            elapsed_s * ADC_RATE_HZ, rel=0.01
        )


def test_its_noise_is_the_same_for_the_same_count_and_never_stands_still():
    runs = []
    for _ in range(2):
        with emulated() as sensor, client_of(sensor) as client:
            runs.append([record.counts for record in asked(client, RdtCommand.START, 300)])
    assert runs[0] == runs[1]
    assert max(len(list(equal)) for _, equal in itertools.groupby(runs[0])) < 3
    assert {count for counts in runs[0] for count in counts} == {-1, 0, 1}


@pytest.mark.parametrize("room_bytes", [64 * 1024, 212_992])
def test_a_socket_that_nobody_reads_keeps_the_oldest_and_drops_the_new(monkeypatch, room_bytes):
    monkeypatch.setattr(simulated_network, "RMEM_MAX_BYTES", room_bytes)
    with emulated() as sensor, client_of(sensor) as client:
        client.send(encode_request(RdtCommand.START))
        client.clock.sleep(3.0)
        client.socket.timeout = 0.0
        numbers = []
        with contextlib.suppress(BlockingIOError):
            while True:
                numbers.append(decode_record(client.recv()).rdt_sequence)
    assert numbers == list(range(1, len(numbers) + 1))
    # Linux doubles what it is asked for and counts 768 bytes for such a datagram: half a second by
    # default.
    assert len(numbers) == 2 * room_bytes // 768 + 1


def test_a_client_of_somebody_else_understands_it():
    with emulated(4.5, 0, -1, 0.25, 0, 0, clock=COMPUTER, rate_hz=200.0) as sensor:
        # This client takes a busy sensor for a broken one.
        sensor.busy_s = 0.0
        client = pynetft.Client(
            pynetft.Config(
                sensor_host="127.0.0.1",
                rdt_port=sensor.rdt_port,
                http_port=sensor.http_port,
                receive_timeout=HANG_S,
                configuration_timeout=HANG_S,
            )
        )
        client.start()
        try:
            assert client.wait_for_first_sample(HANG_S)
            wait_until(lambda: client.health().received_count > 100)
            sample = client.latest_sample()
            health = client.health()
        finally:
            client.stop()
    assert sample.force_unit.value == "N"
    assert sample.torque_unit.value == "N-m"
    assert sample.force[0] == pytest.approx(4.5, rel=1e-3)
    assert sample.torque[0] == pytest.approx(0.25, rel=1e-3)
    assert health.sensor_configuration.product_name == "Emulated Axia80-M20"
    assert (
        health.lost_count,
        health.malformed_count,
        health.duplicate_count,
        health.device_error_count,
    ) == (0,) * 4
