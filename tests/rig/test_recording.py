import pytest

from softfin.core.errors import RunError, SafetyStop, SoftfinError
from softfin.rig.machine import Target
from softfin.storage.bag.messages import CURRENT, DEFAULT_TOPICS, EVENTS
from tests.rig.bags import counts_of, events_of
from tests.rig.test_session import Made


def recorded(session, folder, act):
    with session.recording(folder / "run.mcap"):
        act()


def leave_the_range(made):
    made.moving()
    made.machine.altered = lambda sample: sample._replace(angle=1.9)
    made.session.tick()


def test_a_session_is_recorded_whole(tmp_path):
    made = Made()
    with made.session as session, session.recording(tmp_path / "run.mcap"):
        session.activate()
        session.hold(Target(0.2, 1.0), 20)
        session.deactivate()
    assert events_of(tmp_path / "run.mcap") == ["active: free fin", "inactive"]
    # Ten readings settle that all is well before the motor is enabled.
    assert counts_of(tmp_path / "run.mcap") == {
        DEFAULT_TOPICS["command"]: 2,
        DEFAULT_TOPICS["joint"]: 30,
        DEFAULT_TOPICS["wrench"]: 30,
        CURRENT: 30,
        EVENTS: 2,
    }


def test_the_voltage_is_recorded_if_it_is_measured(tmp_path):
    made = Made()
    made.machine.altered = lambda sample: sample._replace(voltage=12.5)
    with made.session as session, session.recording(tmp_path / "run.mcap"):
        session.activate()
    assert counts_of(tmp_path / "run.mcap")["/fin/channels/voltage_v"] == 10


def test_the_reason_of_a_stop_is_in_the_bag_and_the_bag_is_closed(tmp_path):
    made = Made()
    with made.session as session:
        with pytest.raises(SafetyStop):
            recorded(session, tmp_path, lambda: leave_the_range(made))
        assert session.recorder is None
    assert [
        event
        for event in events_of(tmp_path / "run.mcap")
        if "stopped: angle: the shaft is at 1.900 rad" in event
    ]


def test_what_else_ends_a_session_is_in_the_bag_too_and_stops_the_fin_first(tmp_path):
    made = Made()

    def interrupted():
        made.moving()
        raise KeyboardInterrupt

    with made.session as session, pytest.raises(KeyboardInterrupt):
        recorded(session, tmp_path, interrupted)
    assert made.machine.calls[0] == "stop"
    assert events_of(tmp_path / "run.mcap")[-1] == "ended by KeyboardInterrupt: "


def test_recordings_that_are_there_are_kept_under_other_names(tmp_path):
    path = tmp_path / "run.mcap"
    (tmp_path / "run.cut-2.mcap").write_bytes(b"second")
    for text in (b"first", b"third"):
        path.write_bytes(text)
        made = Made()
        with made.session as session, session.recording(path):
            session.tick()
    kept = {file.name: file.read_bytes() for file in tmp_path.glob("run.cut-*")}
    assert kept == {
        "run.cut-1.mcap": b"first",
        "run.cut-2.mcap": b"second",
        "run.cut-3.mcap": b"third",
    }


def test_a_recording_that_failed_at_the_last_moment_is_an_error(tmp_path):
    made = Made()
    with made.session as session, pytest.raises(RunError, match="recording failed"):
        recorded(session, tmp_path, lambda: session.recorder._fail("disk is gone", "look"))


def test_a_folder_that_cannot_be_written_is_told_before_anything_moves(tmp_path):
    (tmp_path / "file").write_text("")
    made = Made()
    with made.session as session:
        with (
            pytest.raises(SoftfinError, match=r"run\.mcap"),
            session.recording(tmp_path / "file" / "run.mcap"),
        ):
            raise AssertionError("not reached")
        assert "enable" not in made.machine.calls
