import os
import random
import shutil
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from softfin.core.errors import ArtifactError, LogError, SoftfinError
from softfin.data.importing.clocks import build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.rosbag import read_bag
from softfin.emulation.clock import SimulatedClock
from softfin.storage.bag.messages import COMMAND, JOINT, WRENCH
from softfin.storage.bag.recovery import check_bag, recover, recovered_path
from softfin.storage.bag.writer import BagRecorder
from tests.data.recorded import by_mcap_ros2, by_rosbags, record
from tests.patience import HANG_S, wait_until

LONG = os.environ.get("SOFTFIN_LONG") == "1"

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp("bags") / "run.mcap", rows=250)


@pytest.fixture
def damaged(bag, tmp_path):
    """A copy to do harm to, by a function of its bytes."""

    def make(harm):
        path = tmp_path / "harmed.mcap"
        path.write_bytes(bytes(harm(bytearray(bag.read_bytes()))))
        return path

    return make


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Start and end of each."""
    found = []
    at = 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


def process(path, *words):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.data.recording_process", str(path), *map(str, words)]
    return subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20 if LONG else 3))
def test_two_readers_open_what_is_recovered_after_a_kill(tmp_path, seed):
    path = tmp_path / "run.mcap"
    with process(path) as running:
        running.stdout.readline()
        size = path.stat().st_size
        time.sleep(random.Random(seed).uniform(0.2, 2.2))
        wait_until(lambda: path.stat().st_size > size)
        running.kill()
        rows = running.stdout.read().count("\n") + 1
    recovery = recover(path, tmp_path / "saved.mcap")
    assert recovery.damages
    assert all(0 < recovery.messages[role] <= rows + 1 for role in (COMMAND, JOINT, WRENCH))
    first = by_rosbags(tmp_path / "saved.mcap")
    second = by_mcap_ros2(tmp_path / "saved.mcap")
    assert first == second
    assert [row[3] for row in first[JOINT]] == list(range(recovery.messages[JOINT]))
    check_bag(tmp_path / "saved.mcap")


@pytest.mark.slow
def test_a_kill_loses_a_second_at_most(tmp_path):
    """In simulated time; a copy of the file is what a kill at that moment would leave."""
    clock = SimulatedClock()
    recorder = BagRecorder(tmp_path / "run.mcap", clock=clock)
    kills = {random.Random(seed).randrange(60, 400) for seed in range(20)}
    for row in range(max(kills) + 1):
        recorder.joint(clock(), float(row), 0.0, None)
        clock.sleep(0.01)
        if row in kills:
            killed = tmp_path / f"{row}.mcap"
            shutil.copy(recorder.path, killed)
            recovery = recover(killed, tmp_path / f"{row}-saved.mcap")
            assert row + 1 - recovery.messages[JOINT] <= 100
    recorder.close()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the limit is one of POSIX")
def test_a_full_disk_is_told_and_what_was_written_recovers(tmp_path):
    path = tmp_path / "run.mcap"
    with process(path, 100_000) as running:
        out, failure = running.communicate(timeout=HANG_S)
    assert "File too large; the rows so far are kept" in failure
    assert path.stat().st_size == 100_000
    recovery = recover(path, tmp_path / "saved.mcap")
    assert 0 < recovery.messages[WRENCH] <= len(out.splitlines())
    assert by_rosbags(tmp_path / "saved.mcap") == by_mcap_ros2(tmp_path / "saved.mcap")


def test_a_complete_bag_is_copied(bag, tmp_path):
    recovery = recover(bag, tmp_path / "saved.mcap")
    assert not recovery.damages
    assert recovery.messages[JOINT] == 250
    assert by_rosbags(tmp_path / "saved.mcap") == by_rosbags(bag)
    check_bag(bag)


def test_a_cut_chunk_is_lost_and_the_original_stays(several, tmp_path):
    path, data, places = several(CompressionType.NONE)
    path.write_bytes(data[: places[3][1] - 5])
    before = path.read_bytes()
    recovery = recover(path, tmp_path / "saved.mcap")
    assert path.read_bytes() == before
    assert numbers(tmp_path / "saved.mcap") == [*range(30)]
    assert recovery.damages == ((places[3][0], "incomplete record"),)


def test_zeros_that_a_power_cut_left_are_no_values(several, tmp_path):
    path, data, places = several(CompressionType.NONE)
    path.write_bytes(data[: places[2][1]] + bytes(4000))
    recovery = recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(30)]
    assert recovery.damages[0].byte == places[2][1]


@pytest.fixture
def several(tmp_path):
    """A compressed bag of five chunks, each with messages of its own; the bytes, and the chunks'
    places."""

    def make(compression):
        path = tmp_path / "five.mcap"
        with path.open("wb") as file:
            writer = Writer(file, compression=compression)
            writer.start("ros2", "test")
            schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
            channel = writer.register_channel("/n", "cdr", schema)
            for k in range(50):
                data = b"\0\1\0\0" + struct.pack("<d", k)
                writer.add_message(channel, k * 10**9, data, k * 10**9, k)
                if k % 10 == 9:
                    writer.flush()
            writer.finish()
        return path, bytearray(path.read_bytes()), chunks(path.read_bytes())

    return make


def numbers(path):
    return [int(row[1]) for row in by_rosbags(path)["/n"]]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_is_damaged_within_costs_no_other(several, compression, tmp_path):
    path, data, places = several(compression)
    data[places[2][1] - 5] ^= 0xFF
    path.write_bytes(data)
    recovery = recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(20), *range(30, 50)]
    (damage,) = recovery.damages
    assert damage.byte == places[2][0]


def test_topics_of_a_lost_first_chunk_are_read_in_the_index(several, tmp_path):
    path, data, places = several(CompressionType.ZSTD)
    data[places[0][1] - 5] ^= 0xFF
    path.write_bytes(data)
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(10, 50)]


def test_messages_of_which_nothing_says_the_topic_are_counted(several, tmp_path):
    path, data, places = several(CompressionType.ZSTD)
    data[places[0][1] - 5] ^= 0xFF
    path.write_bytes(data[: places[4][0]])
    with pytest.raises(LogError, match="contains no readable messages"):
        recover(path, tmp_path / "saved.mcap")


def test_a_footer_that_is_damaged_is_written_anew(several, tmp_path):
    path, data, _ = several(CompressionType.ZSTD)
    data[-1] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(LogError, match="softfin bag recover"):
        check_bag(path)
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(50)]


def test_what_is_no_bag_is_refused_in_one_line(tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_bytes(b"time,angle\n" * 1000)
    for name in ("empty.mcap", "text.mcap", "none.mcap"):
        with pytest.raises(LogError) as error:
            recover(tmp_path / name, tmp_path / "saved.mcap")
        assert str(error.value).startswith(str(tmp_path / name))
        assert "\n" not in str(error.value)
    with pytest.raises(
        LogError, match=r"cannot be read .Is a directory.; use the path of a \.mcap file"
    ):
        recover(tmp_path, tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()


def test_nothing_is_overwritten_unless_it_is_said_and_never_the_original(damaged, tmp_path):
    path = damaged(lambda data: data[:-1])
    out = recovered_path(path)
    assert out.name == "harmed.recovered.mcap"
    recover(path, out)
    with pytest.raises(ArtifactError, match="already exists"):
        recover(path, out)
    recover(path, out, overwrite=True)
    for overwrite in (False, True):
        with pytest.raises(ArtifactError, match=r"is the damaged recording itself; .*--out"):
            recover(path, path, overwrite)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "harmed.mcap",
        "harmed.recovered.mcap",
    ]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Bytes changed, cut out, repeated, lengths forged; sometimes with the chunk's checksum set
    right again."""
    found = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(found))
        kind = rng.randrange(6)
        if kind == 0:
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            found[at : at + rng.choice((2, 4, 8))] = rng.choice(
                (b"\xff", b"\0", b"\x7f")
            ) * rng.choice((2, 4, 8))
        elif kind == 2:
            del found[at : at + rng.randint(1, 200)]
        elif kind == 3:
            found[at:at] = found[rng.randrange(len(found)) :][: rng.randint(1, 100)]
        elif kind == 4:
            del found[at:]
        else:
            found[at : at + 8] = struct.pack(
                "<Q", rng.choice((2**63, 2**40, 2**32 - 1, 2**31, len(found), 0, 1))
            )
        found = found or bytearray(b"\x89")
    if rng.random() < 0.5:
        for start, end in chunks(bytes(found)):
            if end <= len(found) and end - start >= 49:
                found[start + 33 : start + 37] = struct.pack(
                    "<I", zlib.crc32(found[start + 49 : end])
                )
    return bytes(found)


def refusal(call) -> str | None:
    """The line with which it is refused, if it is; any other exception is a defect."""
    try:
        call()
    except SoftfinError as error:
        return str(error)
    return None


@pytest.mark.slow
def test_no_mutation_of_a_bag_does_more_than_raise_one_line(tmp_path):
    small = record(tmp_path / "small.mcap", rows=6).read_bytes()
    folder = tmp_path / "target"
    folder.mkdir()
    path = folder / "case.mcap"
    out = folder / "saved.mcap"
    counts = Counter()
    config = ImportConfig()
    slowest = 0.0
    for seed in range(100_000 if LONG else 500):
        path.write_bytes(mutated(small, random.Random(seed)))
        start = time.perf_counter()
        counts["recovered", refusal(lambda: recover(path, out)) is None] += 1
        for one in (path, out):
            if one.exists():
                complaint = refusal(
                    lambda one=one: build_logs(read_bag(one, one.name, "train", config), config)
                )
                assert complaint is None or complaint.isprintable(), seed
                counts["read", complaint is None] += 1
        slowest = max(slowest, time.perf_counter() - start)
        out.unlink(missing_ok=True)
        assert [file.name for file in folder.iterdir()] == ["case.mcap"], seed
    assert len(counts) == 4, counts
    assert slowest < HANG_S
    assert sorted(file.name for file in tmp_path.iterdir()) == ["small.mcap", "target"]
