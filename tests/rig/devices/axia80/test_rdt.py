import os
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.rig.devices.axia80.rdt import (
    OVER_RANGE,
    RECORD,
    STATUS_BITS,
    RdtCommand,
    RdtRecord,
    decode_record,
    decode_request,
    decode_status,
    encode_record,
    encode_request,
)
from softfin.rig.loss_estimate import wrapped_step

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 2_000

unsigned = st.integers(0, 2**32 - 1)
signed = st.integers(-(2**31), 2**31 - 1)
records = st.builds(RdtRecord, unsigned, unsigned, unsigned, st.tuples(*[signed] * 6))


@pytest.mark.parametrize(
    ("order", "sent"),
    [(RdtCommand.STOP, "1234000000000000"), (RdtCommand.START, "1234000200000000")],
)
def test_a_request_is_the_eight_bytes_of_the_manual(order, sent):
    assert encode_request(order) == bytes.fromhex(sent)
    assert decode_request(bytes.fromhex(sent)) is order


def test_a_record_is_the_thirty_six_bytes_of_the_manual():
    sent = bytes.fromhex(
        "00000001 00001B58 C0000000 000F4240 FFF0BDC0 7FFFFFFF 80000000 00000000 FFFFFFFF"
    )
    record = RdtRecord(1, 7000, 0xC0000000, (1_000_000, -1_000_000, 2**31 - 1, -(2**31), 0, -1))
    assert encode_record(record) == sent
    assert decode_record(sent) == record


@settings(deadline=None)
@given(records)
def test_what_was_encoded_is_decoded(sent):
    assert decode_record(encode_record(sent)) == sent


@pytest.mark.parametrize("size", [0, 35, 37, 72])
def test_a_datagram_of_another_size_is_refused(size):
    assert decode_record(bytes(size)) is None


@pytest.mark.parametrize("datagram", [bytes(7), bytes(8), bytes.fromhex("1234004100000000")])
def test_a_request_that_is_not_of_an_axia_is_refused(datagram):
    assert decode_request(datagram) is None


def test_any_bytes_are_records_or_refused():
    draw = random.Random(6)
    for _ in range(CASES):
        data = draw.randbytes(draw.choice((8, 36, 72, draw.randrange(200))))
        found = decode_record(data)
        assert (found is not None) == (len(data) == RECORD.size)
        decode_request(data)


@pytest.mark.parametrize(
    ("status", "errors", "notes"),
    [
        (0, [], []),
        (OVER_RANGE, ["force or torque is out of range"], []),
        (0x88000000, ["a gauge is out of range"], []),
        (0xA0000000, ["calibration data is damaged (checksum)"], []),
        (0x80000008, [], ["busy with its settings"]),
        (0x10000000, [], ["forces are simulated"]),
        (
            0x80000001 | 0x2,
            ["temperature is out of range", "supply voltage is out of range"],
            [],
        ),
        (0x80000000, ["status 0x80000000 has unspecified bits"], []),
        (0x90000000, ["status 0x90000000 has unspecified bits"], ["forces are simulated"]),
        (0x80000200, ["status 0x80000200 has unspecified bits"], []),
        (0x00000200, [], ["status 0x00000200 has unspecified bits"]),
        (0x00010000, [], ["a threshold set in the sensor was exceeded"]),
        (0x80000020, ["reports an unspecified error"], []),
        (0x80000080, ["calibration cannot be read"], []),
        (0x80000004, ["a gauge is broken"], []),
    ],
)
def test_a_status_of_the_manual_says_what_it_means(status, errors, notes):
    found = decode_status(status)
    assert [bit.name for bit in found if bit.is_error] == errors
    assert [bit.name for bit in found if not bit.is_error] == notes


@pytest.mark.parametrize(
    ("before", "after", "step"),
    [
        (5, 8, 3),
        (8, 5, -3),
        (2**32 - 1, 0, 1),
        (0, 2**32 - 1, -1),
        (2**31, 2**32 - 1, 2**31 - 1),
        (0, 2**31, -(2**31)),
    ],
)
def test_a_step_of_a_counter_is_the_short_way_round(before, after, step):
    assert wrapped_step(before, after) == step


@settings(deadline=None)
@given(st.integers(1, 2**32 - 1))
def test_no_bit_is_passed_over_in_silence(status):
    found = decode_status(status)
    assert found
    assert all(bit.remedy for bit in found)


@pytest.mark.parametrize("number", [number for number, bit in STATUS_BITS.items() if bit.is_error])
def test_every_error_is_one_without_the_summary_bit_too(number):
    assert decode_status(1 << number) == (STATUS_BITS[number],)
