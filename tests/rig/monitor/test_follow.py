import os
import struct
import time

import numpy as np
import pytest
from mcap.opcode import Opcode

from softfin.core.errors import LogError
from softfin.rig.monitor import follow
from softfin.rig.monitor.follow import ROLES, Follower
from softfin.storage.bag.messages import TYPES
from softfin.storage.bag.recovery import MAX_RECORD_BYTES
from softfin.storage.bag.zero import zero_event
from tests.rig.monitor.bags import START_NS, Recording


def follower(path):
    made = Follower(path)
    made.poll()
    return made


@pytest.fixture
def bag(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def now(monkeypatch):
    """A list with the present time."""
    times = [100.0]
    monkeypatch.setattr(follow.time, "monotonic", lambda: times[0])
    return times


def test_the_topics_are_those_that_are_recorded():
    assert set(ROLES.values()) == set(TYPES)


def test_a_recording_is_told_as_it_was_written(bag):
    bag.write_bytes(Recording().chunk(100, reference=(1.2, -0.6), event="armed").chunk(150).bytes)
    followed = follower(bag)
    summary = followed.summary()
    counted = [summary[name] for name in ("rows", "missing", "force_missing", "damaged")]
    assert counted == [250, 0, 0, 0]
    assert summary["events"] == [(0.0, "armed")]
    assert summary["wall_s"] == pytest.approx(START_NS * 1e-9 + 2.49)
    rows = followed.rows(0)
    joint = np.array(rows["joint"])
    np.testing.assert_allclose(joint[:, 0], np.arange(250) * 0.01, atol=1e-6)
    np.testing.assert_allclose(joint[:, 1], np.arange(250) * 0.001, atol=1e-9)
    assert rows["wrench"][-1] == pytest.approx([2.49, 1.0, -0.5, 0.25])
    assert rows["reference"] == [[0.0, 1.2, -0.6, 0.0]]
    assert rows["current"][-1][1] == pytest.approx(0.25)
    assert rows["command"][0] == [0.0, 0.5, 2.0]


def test_the_estimate_of_feedback_is_shown_with_its_interval_and_level(bag):
    recording = Recording().chunk(10, event=zero_event((0.5, 0.5)))
    bag.write_bytes(recording.chunk(90, estimate=((1.1, -0.4), (0.02, 0.03), 1.5)).bytes)
    rows = follower(bag).rows(0)
    # It is already relative to the zero.
    assert rows["estimate"][-1] == pytest.approx([0.99, 1.1, -0.4, 0.0])
    assert rows["half_width"][-1] == pytest.approx([0.99, 0.02, 0.03, 0.0])
    assert rows["level"][-1] == pytest.approx([0.99, 1.5])


def test_the_force_is_shown_less_the_zero_that_was_measured_last(bag):
    recording = Recording().chunk(100)
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    recording.chunk(150, event=zero_event((1.0, -0.25))).chunk(100, event=zero_event((-2.0, 0.5)))
    bag.write_bytes(recording.bytes)
    followed.poll()
    force = np.array(followed.rows(0)["wrench"])
    # The first zero also holds for the rows before it; the torque has none.
    np.testing.assert_allclose(force[:250, 1:], np.tile([0.0, -0.25, 0.25], (250, 1)), atol=1e-12)
    np.testing.assert_allclose(force[250:, 1:], np.tile([3.0, -1.0, 0.25], (100, 1)), atol=1e-12)


def test_cut_anywhere_only_whole_records_count_and_the_rest_is_read_when_it_comes(bag):
    recording = Recording().chunk(1, event="hello").chunk(1).finish()
    whole = recording.bytes
    ends = recording.ends
    step = 1 if os.environ.get("SOFTFIN_LONG") == "1" else 13
    # Where records begin and end every byte, else some, and in the long version all.
    edges = {cut for end in (0, ends[0], ends[1]) for cut in range(max(end - 20, 0), end + 60)}
    for cut in sorted(edges | set(range(0, len(whole), step))):
        bag.write_bytes(whole[:cut])
        followed = follower(bag)
        summary = followed.summary()
        # A chunk counts from the last of its bytes; its index follows it.
        assert summary["problem"] is None
        least = (cut >= ends[1]) + (cut >= ends[2])
        assert least <= summary["rows"] <= (cut > ends[0]) + (cut > ends[1])
        with bag.open("ab") as file:
            file.write(whole[cut:])
        followed.poll()
        assert (followed.summary()["rows"], followed.summary()["state"]) == (2, "ended")


def test_missing_rows_are_counted(bag):
    bag.write_bytes(Recording().chunk(10).skip(30).chunk(10).bytes)
    summary = follower(bag).summary()
    assert (summary["missing"], summary["force_missing"]) == (30, 30)


def test_memory_is_bounded_and_holds_what_was_asked_for_before(bag, monkeypatch):
    monkeypatch.setattr(follow, "KEPT_ROWS", 300)
    bag.write_bytes(Recording().chunk(50, reference=(1.0, 2.0)).chunk(1000).bytes)
    followed = follower(bag)
    assert followed.summary()["rows"] == 1050
    assert len(followed.rows(0)["joint"]) == 300
    assert followed.rows(0)["reference"][-1] == [0.0, 1.0, 2.0, 0.0]


def test_a_damaged_chunk_is_counted_and_passed_over(bag):
    recording = Recording().chunk(10).chunk(10).chunk(10)
    damaged = bytearray(recording.bytes)
    damaged[recording.ends[1] + 300] ^= 0xFF
    bag.write_bytes(damaged)
    summary = follower(bag).summary()
    assert (summary["rows"], summary["damaged"], summary["missing"]) == (20, 1, 10)


@pytest.mark.parametrize("length", [2**63, 2**64 - 1, MAX_RECORD_BYTES + 1])
def test_a_forged_length_ends_in_one_line_that_stays(bag, length):
    recording = Recording().chunk(10)
    bag.write_bytes(recording.bytes + struct.pack("<BQ", Opcode.CHUNK, length) + bytes(100))
    followed = follower(bag)
    for _ in range(2):
        summary = followed.summary()
        assert (summary["state"], summary["rows"]) == ("damaged", 10)
        assert f"at byte {len(recording.bytes):,}" in summary["problem"]
        followed.poll()


def test_one_look_takes_in_so_much_and_the_next_goes_on(bag, monkeypatch):
    recording = Recording()
    for _ in range(10):
        recording.chunk(10)
    bag.write_bytes(recording.bytes)
    monkeypatch.setattr(follow, "READ_BYTES", len(recording.bytes) // 4)
    followed = follower(bag)
    rows = [followed.summary()["rows"]]
    while rows[-1] < 100:
        followed.poll()
        rows.append(followed.summary()["rows"])
    assert 3 <= len(rows) <= 5


def test_mutated_bags_end_in_counts_or_one_line(bag):
    whole = Recording().chunk(5, event="x").chunk(5).finish().bytes
    random = np.random.default_rng(1)
    for _ in range(100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 300):
        mutated = bytearray(whole)
        for place in random.integers(0, len(whole), random.integers(1, 8)):
            mutated[place] = random.integers(0, 256)
        bag.write_bytes(mutated[: random.integers(1, len(whole) + 1)])
        followed = follower(bag)
        summary = followed.summary()
        followed.rows(0)
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


def test_the_state_goes_from_recording_to_silent_to_ended(bag, now):
    recording = Recording().chunk(10)
    bag.write_bytes(recording.bytes)
    followed = follower(bag)
    assert followed.summary()["state"] == "recording"
    now[0] += 10
    assert followed.summary()["state"] == "silent"
    bag.write_bytes(recording.finish().bytes)
    followed.poll()
    assert followed.summary()["state"] == "ended"


def test_a_folder_means_its_newest_bag_and_moves_on_to_a_newer_one(tmp_path, now):
    old = tmp_path / "a.mcap"
    new = tmp_path / "run" / "b.mcap"
    followed = follower(tmp_path)
    assert (followed.summary()["state"], followed.summary()["problem"]) == ("waiting", None)
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
    assert followed.summary()["path"] == str(old)
    now[0] += 5
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
