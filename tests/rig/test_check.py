from softfin.rig.check import check_rig
from tests.rig.rigs import emulated


def findings(machine, folder):
    return {finding.what: finding for finding in check_rig(machine.config, folder, 0.3, machine.clock)}


def test_each_device_is_looked_at_though_another_is_wrong(tmp_path):
    with emulated() as (behind, robot):
        behind.sensor.close()
        found = findings(robot.machine, tmp_path)
    assert found["force sensor"].state == "wrong"
    assert found["drive"].state == "well"
    assert "100 Hz loop" not in found


def test_a_force_that_is_not_zero_is_a_note_and_says_what_to_do(tmp_path):
    with emulated() as (behind, robot):
        behind.fin.now = lambda now=behind.fin.now: now()._replace(wrench=(0.0, 1.5, 0.0, 0.0, 0.0, 0.0))
        found = findings(robot.machine, tmp_path)
    assert found["force at rest"].state == "note"
    assert "+1.500" in found["force at rest"].text
    assert "softfin rig zero --force" in found["force at rest"].text


def test_a_folder_that_cannot_be_written_is_wrong(tmp_path):
    (tmp_path / "file").write_text("")
    with emulated() as (_, robot):
        found = findings(robot.machine, tmp_path / "file")
    assert found["disk"].state == "wrong"
