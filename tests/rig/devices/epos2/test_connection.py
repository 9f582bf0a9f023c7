"""SDO transfers against canopen's own server, which the emulated drive is, and answers that no
drive should give."""

import struct

import pytest

from softfin.core.errors import DeviceError
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.connection import SDO_TIMEOUT_S
from softfin.rig.devices.epos2.protocol import Object, abort_line
from tests.rig.devices.epos2.bench import NODE, Sniffer, bench

ANSWER = 0x580 + NODE


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        (protocol.HOMING_METHOD, -3),
        (protocol.CURRENT_LIMIT, 0xFFFF),
        (protocol.TARGET, -(2**31)),
        (protocol.POSITION_MAX, 12),
        (protocol.PROFILE_VELOCITY, 2**32 - 1),
    ],
)
def test_a_value_of_each_length_comes_back(entry: Object, value: int) -> None:
    with bench() as made:
        made.drive.connect()
        made.drive.connection.write(entry, value)
        assert made.drive.connection.read(entry) == value


def test_what_the_drive_or_the_object_does_not_take_is_told_in_one_line() -> None:
    with bench() as made:
        made.drive.connect()
        connection = made.drive.connection
        with pytest.raises(
            DeviceError, match=r"refused nonesuch .*0x06020000, object does not exist: check that"
        ):
            connection.read(Object(0x2099, 0, "I", "nonesuch"))
        with pytest.raises(
            DeviceError, match=r"refused mode .*0x06090030, .* use a value in the rig file"
        ):
            connection.write(protocol.MODE, 8)
        with pytest.raises(
            DeviceError, match=r"controlword .* cannot be set to 65536, which .*; change the value"
        ):
            connection.write(protocol.CONTROLWORD, 0x10000)
        with pytest.raises(DeviceError, match="invalid response"):
            connection.read(Object(protocol.TARGET.number, 0, "H", "target of another length"))
        made.emulated.go_silent()
        began = made.clock()
        with pytest.raises(DeviceError, match=r"did not respond for statusword .* within 0.5 s"):
            connection.read(protocol.STATUSWORD)
        assert made.clock() - began == pytest.approx(SDO_TIMEOUT_S)


def test_a_late_answer_to_an_earlier_request_is_not_taken_for_the_answer() -> None:
    with bench() as made, Sniffer(made) as sniffer:
        made.drive.connect()
        sniffer.send(ANSWER, struct.pack("<BHBI", 0x43, protocol.TARGET.number, 0, 7))
        sniffer.send(ANSWER, b"\x43")
        assert made.drive.connection.read(protocol.ENCODER_LINES) == 500
        assert made.drive.counters()["malformed frames"] == 1


@pytest.mark.parametrize("code", [0x0F00FFC0, 0x05040000, 0x06090031, 0x08000022, 0x12345678])
def test_every_abort_has_its_number_a_name_and_a_way_out_in_one_line(code: int) -> None:
    line = abort_line(code)
    assert line.startswith(f"0x{code:08X}, ")
    assert ": " in line
    assert "\n" not in line


def test_a_bus_that_cannot_be_read_is_counted_and_told_each_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench() as made:
        made.drive.connect()
        bus = made.drive.connection._bus
        receive = bus.recv
        failures = [OSError("no such device"), OSError("no such device")]

        def fail_twice(timeout_s: float) -> object:
            if failures:
                raise failures.pop()
            return receive(timeout_s)

        monkeypatch.setattr(bus, "recv", fail_twice)
        made.clock.sleep(1.0)
        assert made.drive.connection.counters["receiving errors"] == 2
        assert any(
            "cannot be read (no such device); check the adapter and cable" in line
            for line in made.faults
        )
