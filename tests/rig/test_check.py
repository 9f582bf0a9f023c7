from softfin.rig.check import check_rig
from tests.rig.rigs import emulated


def findings(machine, folder):
    return {finding.what: finding for finding in check_rig(machine, folder, 0.3)}


def test_each_device_is_looked_at_though_another_is_wrong(tmp_path):
    with emulated() as (behind, robot):
        behind.sensor.close()
        found = findings(robot.machine, tmp_path)
    assert found["force sensor"].state == "wrong"
    assert found["drive"].state == "well"
    assert "100 Hz loop" not in found


def test_a_force_that_is_not_zero_is_a_note_and_says_what_to_do(tmp_path):
    with emulated() as (behind, robot):
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(0.0, 1.5, 0.0, 0.0, 0.0, 0.0)
        )
        found = findings(robot.machine, tmp_path)
    assert found["force at rest"].state == "note"
    assert "+1.500" in found["force at rest"].text
    assert "softfin rig zero --force" in found["force at rest"].text


def test_a_large_fin_has_more_room_for_a_force_that_counts_as_zero(tmp_path):
    with emulated(force_peak_n=300.0) as (behind, robot):
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(0.0, 1.5, 0.0, 0.0, 0.0, 0.0)
        )
        found = findings(robot.machine, tmp_path)
    assert found["force at rest"].state == "well"


def test_a_folder_that_cannot_be_written_is_wrong(tmp_path):
    (tmp_path / "file").write_text("")
    with emulated() as (_, robot):
        found = findings(robot.machine, tmp_path / "file")
    assert found["disk"].state == "wrong"


def test_limits_of_the_current_that_can_never_trip_are_notes(tmp_path):
    with emulated(current_peak_a=4.0, current_sustained_a=2.5) as (_, robot):
        rows = list(check_rig(robot.machine, tmp_path, 0.3))
    notes = [row.text for row in rows if row.what == "safety"]
    assert notes == [
        "current_peak_a 4 A can never trip: the drive limits the current to 4 A; lower this limit",
        "current_sustained_a 2.5 A can never trip: the drive limits the current to 2 A; lower this "
        "limit",
    ]
    with emulated(current_peak_a=3.9, current_sustained_a=2.0) as (_, robot):
        assert "safety" not in findings(robot.machine, tmp_path)
