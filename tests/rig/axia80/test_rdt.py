import os
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.rig.axia80.rdt import (
    MOST_RECORDS,
    RECORD,
    Order,
    Record,
    Request,
    decode_records,
    decode_request,
    encode_record,
    encode_request,
)

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 2_000

unsigned = st.integers(0, 2**32 - 1)
signed = st.integers(-(2**31), 2**31 - 1)
records = st.builds(Record, unsigned, unsigned, unsigned, st.tuples(*[signed] * 6))


@pytest.mark.parametrize(
    ("order", "wanted", "sent"),
    [
        (Order.STOP, 0, "1234000000000000"),
        (Order.START, 0, "1234000200000000"),
        (Order.START_BLOCKS, 7, "1234000300000007"),
        (Order.BIAS, 0, "1234004200000000"),
    ],
)
def test_a_request_is_the_eight_bytes_of_the_manual(order, wanted, sent):
    assert encode_request(order, wanted) == bytes.fromhex(sent)
    assert decode_request(bytes.fromhex(sent)) == Request(order, wanted)


def test_a_record_is_the_thirty_six_bytes_of_the_manual():
    sent = bytes.fromhex("00000001 00001B58 C0000000 000F4240 FFF0BDC0 7FFFFFFF 80000000 00000000 FFFFFFFF")
    record = Record(1, 7000, 0xC0000000, (1_000_000, -1_000_000, 2**31 - 1, -(2**31), 0, -1))
    assert encode_record(record) == sent
    assert decode_records(sent) == (record,)


@settings(deadline=None)
@given(st.lists(records, min_size=1, max_size=MOST_RECORDS))
def test_what_was_encoded_is_decoded(sent):
    assert decode_records(b"".join(map(encode_record, sent))) == tuple(sent)


@settings(deadline=None)
@given(st.sampled_from(Order), unsigned)
def test_what_was_asked_for_is_understood(order, wanted):
    assert decode_request(encode_request(order, wanted)) == Request(order, wanted)


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"", "0 bytes; records have 36 each"),
        (bytes(35), "35 bytes; records have 36 each"),
        (bytes(73), "73 bytes; records have 36 each"),
        (bytes(36 * 41), "1476 bytes; a datagram holds 1440 at most"),
    ],
)
def test_a_datagram_of_another_size_is_refused(datagram, reason):
    assert decode_records(datagram) == reason


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (bytes(7), "7 bytes; a request has 8"),
        (bytes(8), "header 0x0000; a request has 0x1234"),
        (bytes.fromhex("1234004100000000"), "command 0x0041 is none of an Axia's"),
    ],
)
def test_a_request_that_an_axia_does_not_know_is_refused(datagram, reason):
    assert decode_request(datagram) == reason


def test_any_bytes_are_records_or_refused():
    draw = random.Random(6)
    for _ in range(CASES):
        data = draw.randbytes(draw.choice((8, 36, 72, draw.randrange(200))))
        found = decode_records(data)
        assert isinstance(found, str) or len(found) == len(data) // RECORD.size
        decode_request(data)
