"""The bus over TCP, by python-can's own client, in this process and in another."""

import socket
import subprocess
import sys
import uuid
from contextlib import closing

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.choices import LOOPBACK
from softfin.emulation.bus import SocketcandServer, format_frame, parse_frame
from softfin.emulation.epos2.drive import EmulatedDrive
from softfin.rig.bus import BusConfig
from tests.patience import HANG_S, wait_until
from tests.rig.devices.epos2.bench import drive_config
from tests.rig.simple_fin import SimpleFin

pytestmark = pytest.mark.real_time

OTHER_PROCESS = """
import json, sys, time
from softfin.core.errors import DeviceError
from softfin.rig.machine import Target
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.bus import BusConfig
from softfin.rig.devices.epos2.config import Epos2Config

assert "jax" not in sys.modules
given = json.loads(sys.argv[1])
drive = Epos2(BusConfig(**given["bus"]), Epos2Config(**given["drive"]))
end = time.monotonic() + given["hang_s"]
def done(step):
    try:
        step()
        return True
    except DeviceError as error:
        # On a busy machine the answers of another process come later than those of a bus.
        assert time.monotonic() < end, error
        return False
for step in (drive.open, drive.zero, drive.enable):
    while not done(step):
        pass
drive.command(Target(0.4, 3.0))
while abs(drive.sync_and_read(0.05).angle - 0.4) > 1e-3:
    assert time.monotonic() < end
    drive.send_heartbeat()
    time.sleep(0.01)
assert drive.complaints() == (), drive.complaints()
drive.close()
print("moved and stopped")
"""


def test_another_process_drives_the_emulated_drive_over_tcp() -> None:
    import json

    channel = f"test {uuid.uuid4()}"
    fin = SimpleFin()
    config = drive_config(heartbeat_s=1.0)
    virtual = BusConfig(interface="virtual", channel=channel)
    with closing(EmulatedDrive(virtual, config, fin)) as drive, SocketcandServer(channel) as server:
        bus = BusConfig(
            interface="socketcand", channel=channel, options={"host": LOOPBACK, "port": server.port}
        )
        given = json.dumps(
            {"bus": bus.model_dump(), "drive": config.model_dump(), "hang_s": HANG_S}
        )
        command = [sys.executable, "-c", OTHER_PROCESS, given]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S)
        assert ran.stdout.strip() == "moved and stopped", ran.stderr
        assert ran.returncode == 0
        assert ran.stderr == ""
        assert fin.now().angle == pytest.approx(0.4, abs=1e-3)
        assert drive.state.name == "SWITCH_ON_DISABLED"


PROBE = 0x7F0


def hears(client: can.BusABC, sender: can.BusABC) -> bool:
    """Whether the server forwards to this client already: it begins a while after the client was
    made."""
    sender.send(can.Message(arbitration_id=PROBE, is_extended_id=False))
    return client.recv(0.05) is not None


def receive(bus: can.BusABC) -> can.Message | None:
    """The next message that is no probe."""
    while (message := bus.recv(HANG_S)) is not None and message.arbitration_id == PROBE:
        pass
    return message


def test_frames_go_both_ways_between_two_clients_and_the_virtual_bus() -> None:
    channel = f"test {uuid.uuid4()}"
    with (
        SocketcandServer(channel) as server,
        can.Bus(interface="virtual", channel=channel) as inside,
    ):
        options = {"host": LOOPBACK, "port": server.port}
        with (
            can.Bus(interface="socketcand", channel=channel, **options) as first,
            can.Bus(interface="socketcand", channel=channel, **options) as second,
        ):
            for client in (first, second):
                wait_until(lambda client=client: hears(client, inside))
            for data in (b"", b"\x00", bytes(range(8))):
                first.send(can.Message(arbitration_id=0x123, data=data, is_extended_id=False))
                for receiver in (inside, second):
                    message = receive(receiver)
                    assert message is not None
                    assert (message.arbitration_id, bytes(message.data)) == (0x123, data)
            inside.send(can.Message(arbitration_id=0x12345678, data=b"\xfe", is_extended_id=True))
            inside.send(can.Message(arbitration_id=0x7FF, data=b"\xfe", is_extended_id=False))
            message = receive(first)
            assert message is not None
            assert (message.arbitration_id, bytes(message.data)) == (0x7FF, b"\xfe")


@pytest.mark.parametrize(
    "spoken",
    [
        b"GET / HTTP/1.1\r\n\r\n>",
        b"< open other >",
        b"< open CHANNEL >< rawmode >< send 123 9 00 >",
        b"< open CHANNEL >< rawmode >< send 123 2 00 >",
        b"< open CHANNEL >< rawmode >< send FFF 0 >",
        b"< open CHANNEL >< rawmode >< shutdown >",
        b"x" * 2000,
        b"\xff\xfe\x00>",
    ],
)
def test_a_client_that_does_not_speak_the_protocol_is_let_go(spoken: bytes) -> None:
    channel = f"test{uuid.uuid4()}"
    with (
        SocketcandServer(channel) as server,
        can.Bus(interface="virtual", channel=channel) as inside,
    ):
        with socket.create_connection((LOOPBACK, server.port), timeout=HANG_S) as client:
            client.sendall(spoken.replace(b"CHANNEL", channel.encode()))
            try:
                while client.recv(4096):
                    pass
            except ConnectionResetError:
                pass
        assert inside.recv(0.02) is None
        with can.Bus(interface="socketcand", channel=channel, host=LOOPBACK, port=server.port):
            pass


def test_it_listens_on_the_loopback_address_alone() -> None:
    with SocketcandServer("x") as server:
        assert server.socket.getsockname()[0] == "127.0.0.1"


def test_closing_ends_with_clients_still_there() -> None:
    server = SocketcandServer("y")
    with socket.create_connection((LOOPBACK, server.port), timeout=HANG_S):
        server.server_close()
        server.server_close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, server.port), timeout=HANG_S)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_a_frame_comes_back_from_the_line_that_pythoncan_makes_of_it(
    cob_id: int, data: bytes
) -> None:
    from can.interfaces.socketcand import socketcand

    message = can.Message(arbitration_id=cob_id, data=data, is_extended_id=False, timestamp=1.5)
    parsed = parse_frame(" ".join(socketcand.convert_can_message_to_ascii_message(message).split()))
    assert parsed is not None
    assert (parsed.arbitration_id, bytes(parsed.data)) == (cob_id, data)
    read = socketcand.convert_ascii_message_to_can_message(format_frame(message))
    assert (read.arbitration_id, bytes(read.data)) == (cob_id, data)


@given(st.text(max_size=60))
def test_any_line_is_a_frame_or_none(line: str) -> None:
    assert parse_frame(line) is None or line.startswith("< send ")
