import socket
import time

import pytest

from softfin.core.errors import DeviceError
from softfin.rig.computer import COMPUTER
from softfin.rig.devices.axia80.rdt import RdtCommand, RdtRecord, encode_record
from softfin.rig.devices.axia80.stream import RdtClient
from tests.patience import HANG_S


class Sensor:
    """A socket in the sensor's place."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(HANG_S)
        self.socket.bind(("127.0.0.1", 0))
        self.client = RdtClient("127.0.0.1", self.socket.getsockname()[1], COMPUTER)
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


def records_of(client):
    return [arrival.record for arrival in client.drain()]


def test_the_sensor_is_asked_in_eight_bytes(sensor):
    assert sensor.asked == bytes.fromhex("1234000200000000")
    assert sensor.address[0] == "127.0.0.1"


def test_all_that_has_arrived_is_taken_in_order(sensor):
    sensor.send(encode_record(record(1)), encode_record(record(2)))
    assert records_of(sensor.client) == [record(1), record(2)]
    assert records_of(sensor.client) == []


def test_what_others_send_is_not_taken(sensor):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(encode_record(record(1)), sensor.address)
    assert records_of(sensor.client) == []
    assert sensor.client.refused == 0


def test_what_is_no_record_is_counted_and_not_taken(sensor):
    sensor.send(b"", bytes(35), bytes(72), bytes(36 * 200), encode_record(record(1)))
    assert records_of(sensor.client) == [record(1)]
    assert sensor.client.refused == 4


def test_a_record_is_stamped_no_earlier_than_it_was_sent_and_no_later_than_it_was_taken(sensor):
    before = time.monotonic()
    sensor.send(encode_record(record(1)))
    ((_, arrived),) = sensor.client.drain()
    assert before <= arrived <= time.monotonic()


@pytest.mark.parametrize("host", ["no such host", "192.168.1.1.1", "a" * 300])
def test_an_address_that_cannot_be_is_an_error_and_leaves_nothing_open(host):
    with pytest.raises(DeviceError, match=r"cannot be reached .*check its address"):
        RdtClient(host, 49152, COMPUTER)


def test_a_closed_socket_sends_nothing_and_closes_again(sensor):
    sensor.client.close()
    sensor.client.close()
    assert sensor.client.closed
    assert not sensor.client.send(RdtCommand.STOP)
