import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.rig.axia80.status import BITS, BUSY, CHECKSUM, GAGE_OUT_OF_RANGE, OVER_RANGE, SIMULATED, decode_status


@pytest.mark.parametrize(
    ("status", "errors", "notes"),
    [
        (0, [], []),
        (OVER_RANGE, ["force or torque is out of its range"], []),
        (GAGE_OUT_OF_RANGE, ["a gage is out of range"], []),
        (CHECKSUM, ["its calibration is damaged (checksum)"], []),
        (BUSY, [], ["it is busy with its settings"]),
        (SIMULATED, [], ["its forces are simulated"]),
        (0x80000001 | 0x2, ["its temperature is out of range", "its supply voltage is out of range"], []),
        (0x80000000, ["it reports an error without a name (0x80000000)"], []),
        (0x80000000 | SIMULATED, ["it reports an error without a name (0x90000000)"], ["its forces are simulated"]),
        (0x80000200, ["unknown status bits are set (9 of 0x80000200)"], []),
        (0x00000200, [], ["unknown status bits are set (9 of 0x00000200)"]),
    ],
)
def test_a_status_of_the_manual_says_what_it_means(status, errors, notes):
    found = decode_status(status)
    assert [bit.name for bit in found.errors] == errors
    assert [bit.name for bit in found.notes] == notes


@settings(deadline=None)
@given(st.integers(1, 2**32 - 1))
def test_no_bit_is_passed_over_in_silence(status):
    found = decode_status(status)
    assert found.errors or found.notes
    assert all(bit.remedy for bit in (*found.errors, *found.notes))
    assert all(bit.error for bit in found.errors)
    assert not any(bit.error for bit in found.notes)


@pytest.mark.parametrize("number", [number for number, bit in BITS.items() if bit.error])
def test_every_error_is_one_without_the_summary_bit_too(number):
    assert decode_status(1 << number).errors == (BITS[number],)
