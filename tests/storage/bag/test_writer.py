import contextlib
import errno
import io
import os
import threading
import time

import numpy as np
import pytest

from softfin.core.errors import LogError, RunError
from softfin.data.importing.rosbag import READABLE_TYPES as READABLE
from softfin.data.recordings import open_logs
from softfin.storage.bag import writer as bag_writer
from softfin.storage.bag.messages import (
    COMMAND,
    CURRENT,
    DEFAULT_TOPICS,
    EVENTS,
    JOINT,
    REFERENCE,
    TYPES,
    WRENCH,
)
from softfin.storage.bag.recovery import recover
from softfin.storage.bag.writer import BagRecorder
from tests.data.recorded import by_mcap_ros2, by_rosbags, record
from tests.patience import HANG_S, wait_until
from tests.rig.machines import Hours


def test_two_readers_find_the_same_values_in_a_recorded_bag(tmp_path):
    path = record(tmp_path / "run.mcap")
    first = by_rosbags(path)
    second = by_mcap_ros2(path)
    assert first == second
    assert {topic: len(rows) for topic, rows in first.items()} == {
        COMMAND: 300,
        JOINT: 300,
        WRENCH: 300,
        CURRENT: 300,
        REFERENCE: 3,
        EVENTS: 3,
    }
    logged, stamp, name, *numbers = first[JOINT][123]
    assert logged == stamp
    assert name == "fin"
    assert numbers == [0.001 * 123, 0.1]
    assert first[WRENCH][7][2:] == ("fin", 0.5, -0.001 * 7, 0.1, 0.2, 0.3, 0.4)
    assert first[REFERENCE][0][3:] == (0.25, -0.5, 0.0, 0.0, 0.0, 0.0)
    assert first[CURRENT][0][1] == 0.25
    assert first[EVENTS][2][1] == "row 200"


def test_stamps_are_the_clock_plus_what_the_wall_clock_was_ahead_at_the_start(
    tmp_path, monkeypatch
):
    hours = Hours()
    hours.now = 50.0
    recorder = BagRecorder(tmp_path / "run.mcap", clock=hours)
    began = time.time()
    monkeypatch.setattr(hours, "wall", lambda: 0.0)
    recorder.event(50.0, "first")
    recorder.event(51.5, "second")
    recorder.close()
    (first, _), (second, _) = by_rosbags(recorder.path)[EVENTS]
    assert second - first == 1_500_000_000
    assert abs(first / 1e9 - began) < 60


def test_a_recorded_bag_opens_as_a_log(tmp_path):
    path = record(tmp_path / "run.mcap")
    opened = open_logs(path)
    (one,) = opened.logs
    assert len(one.log.reading.time) == 300
    np.testing.assert_array_equal(one.log.reading.angle, np.float32(0.001 * np.arange(300)))
    np.testing.assert_array_equal(one.log.reading.force[:, 1], np.float32(-0.001 * np.arange(300)))
    assert not [issue for issue in opened.inspection.issues if issue.severity == "error"]


def test_the_topics_are_those_that_are_read_by_default():
    for role, topic in DEFAULT_TOPICS.items():
        assert TYPES[topic] in READABLE[role]


def test_rows_are_in_the_file_before_it_is_closed(tmp_path):
    recorder = BagRecorder(tmp_path / "run.mcap", flush_s=0.05)
    empty = recorder.path.stat().st_size
    recorder.wrench(time.monotonic(), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    wait_until(lambda: recorder.path.stat().st_size > empty)
    recovery = recover(recorder.path, tmp_path / "saved.mcap")
    assert recovery.messages == {WRENCH: 1}
    recorder.close()


def test_nothing_is_overwritten_and_a_second_recorder_is_refused(tmp_path):
    with contextlib.closing(BagRecorder(tmp_path / "new" / "run.mcap")) as recorder:
        with pytest.raises(
            LogError, match="already exists, and recordings are never overwritten"
        ) as error:
            BagRecorder(recorder.path)
        assert "\n" not in str(error.value)
    assert by_rosbags(recorder.path) == {}
    with pytest.raises(RunError, match="cannot be written"):
        BagRecorder(recorder.path / "below" / "run.mcap")


def test_a_disk_without_room_is_known_before_anything_moves(tmp_path):
    with pytest.raises(
        RunError, match="of disk space left; the rows so far are kept; free disk space"
    ):
        BagRecorder(tmp_path / "run.mcap", reserve_bytes=10**18)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_is_told_and_what_was_written_recovers(tmp_path, monkeypatch, number):
    room = [10**6]

    class Limited(io.FileIO):
        def write(self, data):
            # Not exactly 0, because the test may set it during a write.
            if room[0] <= 0:
                raise OSError(number, os.strerror(number))
            taken = super().write(bytes(data[: room[0]]))
            room[0] -= taken
            return taken

    monkeypatch.setattr(io, "FileIO", Limited)
    recorder = BagRecorder(tmp_path / "run.mcap", flush_s=0.05)
    assert recorder.failure is None
    empty = recorder.path.stat().st_size
    for k in range(200):
        recorder.wrench(k / 100, (float(k), 0.0, 0.0, 0.0, 0.0, 1.0))
    wait_until(lambda: recorder.path.stat().st_size > empty)
    room[0] = 500
    for k in range(200, 400):
        recorder.wrench(k / 100, (float(k), 0.0, 0.0, 0.0, 0.0, 1.0))
    wait_until(lambda: recorder.failure is not None)
    assert os.strerror(number) in recorder.failure
    assert "softfin bag recover" in recorder.failure
    assert "\n" not in recorder.failure
    recorder.event(3.0, "stopped")
    recorder.close()
    monkeypatch.undo()
    recovery = recover(recorder.path, tmp_path / "saved.mcap")
    assert 0 < recovery.messages[WRENCH] < 400
    assert by_rosbags(tmp_path / "saved.mcap") == by_mcap_ros2(tmp_path / "saved.mcap")


def test_a_disk_that_has_room_again_gets_the_tail(tmp_path, monkeypatch):
    fsync = os.fsync
    full = [True]

    def sync(file):
        if full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    recorder = BagRecorder(tmp_path / "run.mcap", flush_s=0.05)
    monkeypatch.setattr(os, "fsync", sync)
    recorder.event(1.0, "before")
    wait_until(lambda: recorder.failure is not None)
    full[0] = False
    recorder.event(2.0, "after")
    recorder.close()
    assert recorder.failure is not None
    assert [row[1] for row in by_rosbags(recorder.path)[EVENTS]] == ["before", "after"]


def test_a_disk_that_hangs_is_told_and_close_gives_up(tmp_path, monkeypatch):
    hold = threading.Event()
    hangs = threading.Event()
    recorder = BagRecorder(tmp_path / "run.mcap", flush_s=0.05)
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (hangs.set(), hold.wait(HANG_S), fsync(file)))
    monkeypatch.setattr(bag_writer, "CLOSE_S", 0.2)
    monkeypatch.setattr(bag_writer, "BACKLOG", 10)
    assert hangs.wait(HANG_S)
    for k in range(11):
        assert recorder.failure is None
        recorder.event(float(k), "x")
    assert "10 rows are waiting to be written" in recorder.failure
    recorder.close()
    assert recorder._thread.is_alive()
    hold.set()
    recorder._thread.join(HANG_S)


def test_a_disk_that_takes_nothing_for_long_is_told_at_the_next_row(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_writer, "POLL_S", 30.0)
    recorder = BagRecorder(tmp_path / "run.mcap")
    recorder.event(1.0, "first")
    assert recorder.failure is None
    monkeypatch.setattr(bag_writer, "STALL_S", 0.0)
    recorder.event(2.0, "second")
    assert "1 rows are waiting to be written" in recorder.failure
    recorder.close()
    assert [row[1] for row in by_rosbags(recorder.path)[EVENTS]] == ["first", "second"]


def test_a_disk_that_is_too_slow_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_writer, "BACKLOG", 10)
    monkeypatch.setattr(bag_writer, "POLL_S", 30.0)
    recorder = BagRecorder(tmp_path / "run.mcap")
    for k in range(25):
        recorder.event(float(k), "x")
    assert "10 rows are waiting to be written" in recorder.failure
    recorder.close()
    assert len(by_rosbags(recorder.path)[EVENTS]) == 10


def test_a_row_that_cannot_be_written_spoils_no_other(tmp_path):
    recorder = BagRecorder(tmp_path / "run.mcap")
    recorder.wrench(1.0, (1.0, 2.0))
    recorder.event(2.0, "still here")
    recorder.close()
    assert "/fin/wrench: invalid values (1.0, 2.0)" in recorder.failure
    assert list(by_rosbags(recorder.path)) == [EVENTS]


def test_close_may_be_called_again_and_leaves_no_thread(tmp_path):
    recorder = BagRecorder(tmp_path / "run.mcap")
    recorder.close()
    recorder.close()
    assert not recorder._thread.is_alive()
    assert recorder.failure is None


def test_two_commands_at_one_moment_keep_their_order(tmp_path):
    recorder = BagRecorder(tmp_path / "run.mcap", clock=Hours())
    for angle in (0.1, 0.2, 0.3):
        recorder.command(1000.0, angle, 1.0)
    recorder.command(1000.5, 0.4, 1.0)
    recorder.close()
    rows = by_rosbags(recorder.path)[DEFAULT_TOPICS["command"]]
    stamps = [stamp for stamp, *_ in rows]
    assert stamps[0] < stamps[1] < stamps[2]
    assert [row[3] for row in rows] == [0.1, 0.2, 0.3, 0.4]
    assert stamps[3] - stamps[0] == 500_000_000
