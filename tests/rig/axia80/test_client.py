import socket
import time

import pytest

from softfin.core.clock import REAL, RealClock
from softfin.core.errors import DeviceError
from softfin.rig.axia80.client import RdtClient
from softfin.rig.axia80.rdt import RdtCommand, RdtRecord, encode_record


class Sensor:
    """A socket in the sensor's place."""

    def __init__(self, clock=REAL):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(5)
        self.socket.bind(("127.0.0.1", 0))
        self.client = RdtClient("127.0.0.1", self.socket.getsockname()[1], clock)
        self.client.send(RdtCommand.START)
        self.asked, self.address = self.socket.recvfrom(100)

    def send(self, *datagrams):
        for datagram in datagrams:
            self.socket.sendto(datagram, self.address)

    def close(self):
        self.client.close()
        self.socket.close()


@pytest.fixture
def sensor():
    sensor = Sensor()
    yield sensor
    sensor.close()


def record(number):
    return RdtRecord(number, 8 * number, 0, (1, 2, 3, 4, 5, 6))


def test_the_sensor_is_asked_in_eight_bytes(sensor):
    assert sensor.asked == bytes.fromhex("1234000200000000")
    assert sensor.address[0] == "127.0.0.1"


def test_datagrams_of_one_or_several_records_are_taken(sensor):
    sensor.send(encode_record(record(1)), encode_record(record(2)) + encode_record(record(3)))
    assert [records for records, _ in sensor.client.drain()] == [(record(1),), (record(2), record(3))]
    assert sensor.client.drain() == []


def test_what_others_send_is_not_taken(sensor):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(encode_record(record(1)), sensor.address)
    assert sensor.client.drain() == []
    assert sensor.client.refused == 0


def test_what_is_no_record_is_counted_and_not_taken(sensor):
    sensor.send(b"", bytes(35), bytes(36 * 41), bytes(36 * 200), encode_record(record(1)))
    assert len(sensor.client.drain()) == 1
    assert sensor.client.refused == 4


@pytest.mark.parametrize("jump_s", [0.0, -3600.0, 3600.0])
def test_a_wall_clock_that_jumps_moves_no_stamp_out_of_the_drain(jump_s):
    jumped = 0.0

    class JumpingClock(RealClock):
        def wall(self):
            return time.time() + jumped

    sensor = Sensor(JumpingClock())
    try:
        sensor.client.drain()
        before = time.monotonic()
        sensor.send(encode_record(record(1)))
        jumped = jump_s
        ((_, received),) = sensor.client.drain()
        assert before - 5 < received <= time.monotonic()
    finally:
        sensor.close()


def test_a_record_that_waited_is_stamped_with_its_arrival(sensor):
    def waited(number):
        sensor.client.drain()
        sensor.send(encode_record(record(number)))
        sent = time.monotonic()
        time.sleep(0.05)
        ((_, received),) = sensor.client.drain()
        return received - sent

    first = waited(1)
    if not sensor.client._stamped:
        pytest.skip("this system does not stamp what arrives")
    # A busy machine may delay an arrival; a record that is stamped when it is read never has less than the wait.
    assert first < 0.04 or any(waited(number) < 0.04 for number in range(2, 50))


@pytest.mark.parametrize("host", ["no such host", "192.168.1.1.1", "a" * 300])
def test_an_address_that_cannot_be_is_an_error_and_leaves_nothing_open(host):
    with pytest.raises(DeviceError, match=r"cannot be reached .*check its address"):
        RdtClient(host, 49152, REAL)


def test_a_closed_socket_sends_nothing_and_closes_again(sensor):
    sensor.client.close()
    sensor.client.close()
    assert sensor.client.closed
    assert not sensor.client.send(RdtCommand.STOP)
