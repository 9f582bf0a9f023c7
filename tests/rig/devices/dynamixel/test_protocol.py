"""Packets against those that the e-Manual prints, and streams of bytes that are cut or garbled."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.protocol import (
    Instruction,
    Packet,
    PacketParser,
    encode_packet,
    error_line,
)

PRINTED = {
    "FF FF FD 00 01 03 00 01 19 4E": Packet(1, Instruction.PING, b""),
    "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D": Packet(1, 0x55, bytes.fromhex("00060426")),
    "FF FF FD 00 FE 03 00 01 31 42": Packet(protocol.BROADCAST, Instruction.PING, b""),
    "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15": Packet(1, 0x02, bytes.fromhex("84000400")),
    "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0": Packet(1, 0x55, bytes.fromhex("00A6000000")),
    "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89": Packet(
        1, Instruction.WRITE, bytes.fromhex("740000020000")
    ),
    "FF FF FD 00 01 04 00 55 00 A1 0C": Packet(1, Instruction.STATUS, b"\x00"),
    "FF FF FD 00 01 03 00 08 2F 4E": Packet(1, Instruction.REBOOT, b""),
    "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA": Packet(
        protocol.BROADCAST, Instruction.SYNC_READ, bytes.fromhex("840004000102")
    ),
}
"""From "DYNAMIXEL Protocol 2.0", Instruction Details."""

PACKETS = st.builds(
    Packet,
    st.integers(0, 252),
    st.sampled_from([int(instruction) for instruction in Instruction]),
    # Made of few values, so that headers appear inside.
    st.lists(st.sampled_from([0x00, 0xFD, 0xFE, 0xFF]), max_size=30).map(bytes),
)


@pytest.mark.parametrize("printed", PRINTED)
def test_the_packets_of_the_manual_are_written_and_read(printed):
    data = bytes.fromhex(printed)
    assert encode_packet(PRINTED[printed]) == data
    assert PacketParser().feed(data) == [PRINTED[printed]]


@given(st.lists(PACKETS, max_size=5), st.integers(1, 20))
def test_packets_come_back_from_a_stream_in_pieces(packets, size):
    stream = b"".join(map(encode_packet, packets))
    parser = PacketParser()
    found = []
    for start in range(0, len(stream), size):
        found += parser.feed(stream[start : start + size])
    assert found == packets
    assert parser.crc_errors == 0


@given(PACKETS, st.data())
def test_a_changed_bit_is_noticed(packet, data):
    stream = bytearray(encode_packet(packet))
    bit = data.draw(st.integers(0, 8 * len(stream) - 1))
    stream[bit // 8] ^= 1 << bit % 8
    assert PacketParser().feed(bytes(stream)) == []


@given(st.binary(max_size=60), PACKETS)
def test_nonsense_before_a_packet_delays_it_at_most(nonsense, packet):
    parser = PacketParser()
    found = parser.feed(nonsense + encode_packet(packet))
    # A header in the nonsense may announce up to so many bytes.
    found += parser.feed(bytes(protocol.MAX_PACKET_BYTES))
    assert packet in found


def test_a_status_has_the_bytes_of_its_entries():
    assert len(protocol.STATUS_ADDRESSES) == protocol.STATUS_LAYOUT.size <= 28
    assert protocol.STATUS_ADDRESSES[:4] == (64, 70, 98, 116)
    assert len(protocol.Status._fields) == len(protocol.STATUS_ENTRIES)


def test_hardware_errors_have_names_and_a_fix():
    assert error_line(0x24).startswith("servo reports hardware error 0x24, overheating, overload: ")
    assert "e-Manual" in error_line(0x40)
