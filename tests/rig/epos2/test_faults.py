import pytest

from softfin.rig.epos2.faults import ABORTS, FAULTS, abort_line, fault_line


@pytest.mark.parametrize("code", [*FAULTS, 0x1234])
def test_every_fault_has_its_number_a_name_and_a_way_out_in_one_line(code: int) -> None:
    line = fault_line(code)
    assert line.startswith(f"drive fault 0x{code:04X}, ")
    assert ": " in line
    assert "\n" not in line


@pytest.mark.parametrize("code", [*ABORTS, 0x12345678])
def test_every_abort_has_its_number_a_name_and_a_way_out_in_one_line(code: int) -> None:
    line = abort_line(code)
    assert line.startswith(f"0x{code:08X}, ")
    assert ": " in line
    assert "\n" not in line


def test_the_faults_that_matter_most_are_told_by_name() -> None:
    assert "following error" in fault_line(0x8611)
    assert "heartbeat" in fault_line(0x8130)
    assert "bus off" in fault_line(0x81FD)
    assert "does not exist" in abort_line(0x06020000)
