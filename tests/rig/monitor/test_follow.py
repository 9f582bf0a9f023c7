import os
import struct
import time

import numpy as np
import pytest
from mcap.opcode import Opcode

from softfin.core.errors import LogError
from softfin.rig.monitor import follow
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import ROLES, decode_message
from softfin.storage.bag.messages import TYPES
from softfin.storage.bag.recovery import MAX_RECORD_BYTES
from softfin.storage.bag.zero import zero_event
from tests.rig.monitor.bags import START_NS, Recording


def follower(path, **options):
    options.setdefault("wall", lambda: START_NS * 1e-9 + 5.0)
    made = Follower(path, **options)
    made.poll()
    return made


@pytest.fixture
def bag(tmp_path):
    return tmp_path / "run.mcap"


def test_the_topics_are_those_that_are_recorded():
    assert set(ROLES.values()) == set(TYPES)


def test_a_recording_is_told_as_it_was_written(bag):
    recording = Recording().chunk(100, reference=(1.2, -0.6), event="armed").chunk(150)
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    summary = followed.summary()
    assert (
        summary["rows"],
        summary["gaps"],
        summary["force_gaps"],
        summary["damaged"],
        summary["unreadable"],
    ) == (
        250,
        0,
        0,
        0,
        0,
    )
    assert summary["rate_hz"] == pytest.approx(100)
    assert (
        summary["angle_rad"],
        summary["current_a"],
        summary["command_angle_rad"],
    ) == pytest.approx((0.249, 0.25, 0.5))
    assert summary["mean_force_n"] == pytest.approx((1.0, -0.5))
    assert summary["reference_n"] == pytest.approx((1.2, -0.6))
    assert summary["events"] == [(0.0, "armed")]
    assert summary["age_s"] == pytest.approx(5.0 - 2.49, abs=1e-3)
    joint = followed.traces["joint"].array()
    np.testing.assert_allclose(joint[:, 0], np.arange(250) * 0.01, atol=1e-6)
    np.testing.assert_allclose(joint[:, 1], np.arange(250) * 0.001, atol=1e-9)


def test_the_mean_is_of_the_last_two_seconds_and_none_before(bag):
    recording = Recording().chunk(199)
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    assert followed.summary()["mean_force_n"] is None
    bag.write_bytes(recording.chunk(1).bytes)
    followed.poll()
    assert followed.summary()["mean_force_n"] == pytest.approx((1.0, -0.5))
    bag.write_bytes(recording.chunk(100, force=(3.0, -0.5)).bytes)
    followed.poll()
    assert followed.summary()["mean_force_n"] == pytest.approx((2.0, -0.5))


def test_the_force_is_shown_less_the_zero_that_was_measured_last(bag):
    recording = Recording().chunk(200).chunk(200, event=zero_event((1.0, -0.25)))
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    assert followed.summary()["force_n"] == pytest.approx((0.0, -0.25))
    assert followed.summary()["mean_force_n"] == pytest.approx((0.0, -0.25))
    bag.write_bytes(
        recording.chunk(100, event="inactive").chunk(200, event=zero_event((-2.0, 0.5))).bytes
    )
    followed.poll()
    assert followed.summary()["force_n"] == pytest.approx((3.0, -1.0))
    assert followed.summary()["torque_nm"] == 0.25
    force = followed.traces["wrench"].array()
    np.testing.assert_allclose(
        force[force[:, 0] < 4.995, 1:], np.tile([0.0, -0.25, 0.25], (500, 1)), atol=1e-12
    )


def test_a_zero_that_is_read_later_holds_for_the_rows_before_it(bag):
    recording = Recording().chunk(100)
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    bag.write_bytes(recording.chunk(150, event=zero_event((1.0, -0.25))).bytes)
    followed.poll()
    assert followed.summary()["mean_force_n"] == pytest.approx((0.0, -0.25))
    force = followed.traces["wrench"].array()
    np.testing.assert_allclose(force[:, 1:], np.tile([0.0, -0.25, 0.25], (250, 1)), atol=1e-12)


def test_cut_at_every_byte_only_whole_records_count_and_the_rest_is_read_when_it_comes(bag):
    recording = Recording().chunk(1, event="hello").chunk(1).finish()
    whole = recording.bytes
    ends = recording.ends
    step = 1 if os.environ.get("SOFTFIN_LONG") == "1" else 13
    # Where records begin and end every byte, else some, and in the long version all.
    edges = {cut for end in (0, ends[0], ends[1]) for cut in range(max(end - 20, 0), end + 60)}
    for cut in sorted(
        edges | set(range(ends[0] if step > 1 else 0, ends[1] if step > 1 else len(whole), step))
    ):
        bag.write_bytes(whole[:cut])
        followed = follower(bag)
        summary = followed.summary()
        # A chunk counts from the last of its bytes; its index follows it, and a second one comes
        # before its end.
        assert summary["problem"] is None
        assert (
            (cut >= ends[1]) + (cut >= ends[2])
            <= summary["rows"]
            <= (cut > ends[0]) + (cut > ends[1])
        )
        with bag.open("ab") as file:
            file.write(whole[cut:])
        followed.poll()
        assert (followed.summary()["rows"], followed.summary()["state"]) == (2, "ended")


def test_missing_rows_are_counted(bag):
    bag.write_bytes(Recording().chunk(10).skip(30).chunk(10).bytes)
    summary = follower(bag).summary()
    assert (
        summary["gaps"],
        summary["missing"],
        summary["force_gaps"],
        summary["force_missing"],
    ) == (1, 30, 1, 30)


def test_memory_holds_the_window_and_what_was_asked_for_before_it(bag):
    recording = Recording().chunk(50, reference=(1.0, 2.0)).chunk(1000)
    bag.write_bytes(recording.bytes)
    followed = follower(bag, window_s=3.0)
    assert followed.summary()["rows"] == 1050
    assert len(followed.traces["joint"].rows) <= 302
    assert followed.summary()["reference_n"] == (1.0, 2.0)


def test_a_damaged_chunk_is_counted_and_passed_over(bag):
    recording = Recording().chunk(10).chunk(10).chunk(10)
    damaged = bytearray(recording.bytes)
    damaged[recording.ends[1] + 300] ^= 0xFF
    bag.write_bytes(damaged)
    summary = follower(bag).summary()
    assert (summary["rows"], summary["damaged"], summary["gaps"]) == (20, 1, 1)


@pytest.mark.parametrize("length", [2**63, 2**64 - 1, MAX_RECORD_BYTES + 1])
def test_a_forged_length_ends_in_one_line_that_says_what_to_do(bag, length):
    recording = Recording().chunk(10)
    bag.write_bytes(recording.bytes + struct.pack("<BQ", Opcode.CHUNK, length) + bytes(100))
    summary = follower(bag).summary()
    assert (summary["state"], summary["rows"]) == ("damaged", 10)
    assert f"at byte {len(recording.bytes):,}" in summary["problem"]
    assert "softfin bag recover" in summary["problem"]
    assert "\n" not in summary["problem"]


def test_one_look_takes_in_so_much_and_the_next_goes_on(bag, monkeypatch):
    recording = Recording()
    for _ in range(10):
        recording.chunk(10)
    bag.write_bytes(recording.bytes)
    monkeypatch.setattr(follow, "READ_BYTES", len(recording.bytes) // 4)
    followed = follower(bag)
    rows = []
    while followed.summary()["state"] == "reading":
        rows.append(followed.summary()["rows"])
        followed.poll()
    assert 3 <= len(rows) <= 5
    assert rows == sorted(set(rows))
    assert (followed.summary()["rows"], followed.summary()["damaged"]) == (100, 0)


def test_mutated_bags_end_in_counts_or_one_line(bag):
    whole = Recording().chunk(5, event="x").chunk(5).finish().bytes
    random = np.random.default_rng(1)
    for _ in range(100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 300):
        mutated = bytearray(whole)
        for place in random.integers(0, len(whole), random.integers(1, 8)):
            mutated[place] = random.integers(0, 256)
        bag.write_bytes(mutated[: random.integers(1, len(whole) + 1)])
        summary = follower(bag).summary()
        assert summary["rows"] <= 10
        assert summary["problem"] is None or "\n" not in summary["problem"]


def test_bytes_that_are_not_there_yet_are_waited_for(bag):
    recording = Recording().chunk(10)
    before = recording.bytes
    after = recording.chunk(10).bytes
    bag.write_bytes(before + bytes(len(after) - len(before)))
    followed = follower(bag)
    assert (followed.summary()["rows"], followed.summary()["problem"]) == (10, None)
    bag.write_bytes(after)
    followed.poll()
    assert followed.summary()["rows"] == 20


def test_the_state_goes_from_recording_to_silent_to_ended(bag):
    now = [100.0]
    recording = Recording().chunk(10)
    bag.write_bytes(recording.bytes)
    followed = follower(bag, clock=lambda: now[0], wall=lambda: START_NS * 1e-9 + 0.5)
    assert followed.summary()["state"] == "recording"
    bag.write_bytes(recording.chunk(10).bytes)
    followed.poll()
    now[0] += 10
    assert followed.summary()["state"] == "silent"
    bag.write_bytes(recording.finish().bytes)
    followed.poll()
    assert followed.summary()["state"] == "ended"


def test_a_folder_means_its_newest_bag_and_moves_on_to_a_newer_one(tmp_path):
    now = [0.0]
    old = tmp_path / "a.mcap"
    new = tmp_path / "run" / "b.mcap"
    followed = follower(tmp_path, clock=lambda: now[0])
    assert followed.summary()["state"] == "waiting"
    old.write_bytes(Recording().chunk(5).bytes)
    now[0] += 2
    followed.poll()
    first = followed.summary()
    assert (first["path"], first["rows"]) == (str(old), 5)
    new.parent.mkdir()
    new.write_bytes(Recording().chunk(7).bytes)
    os.utime(new, (time.time() + 10, time.time() + 10))
    now[0] += 2
    followed.poll()
    second = followed.summary()
    assert (second["path"], second["rows"]) == (str(new), 7)
    assert second["number"] > first["number"]


def test_a_file_that_is_replaced_is_read_anew_and_one_that_goes_is_waited_for(bag):
    bag.write_bytes(Recording().chunk(20).bytes)
    followed = follower(bag)
    bag.write_bytes(Recording().chunk(3).bytes)
    followed.poll()
    assert followed.summary()["rows"] == 3
    bag.unlink()
    followed.poll()
    assert "cannot be read" in followed.summary()["problem"]


def test_what_is_no_bag_is_said(tmp_path):
    with pytest.raises(LogError, match="no such file or folder; use a bag"):
        Follower(tmp_path / "none.mcap")
    other = tmp_path / "text.mcap"
    other.write_text("SQLite format 3")
    assert "not an MCAP file" in follower(other).summary()["problem"]


def test_a_message_of_another_type_is_no_message():
    assert decode_message("joint", "std_msgs/msg/String", b"") is None
    assert decode_message("joint", "sensor_msgs/msg/JointState", b"\0\1\0\0" + b"\xff" * 40) is None
