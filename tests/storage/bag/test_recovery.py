import itertools
import os
import random
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter, deque
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from softfin.core.errors import LogError, SoftfinError
from softfin.data.importing.clocks import logs_of
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.rosbag import read_bag
from softfin.storage.bag import chunks as mcap_chunks
from softfin.storage.bag import recovery as bag_recovery
from softfin.storage.bag import scan as bag_scan
from softfin.storage.bag.messages import COMMAND, JOINT, WRENCH
from softfin.storage.bag.recovery import recover, recovered_path
from softfin.storage.bag.scan import BagScan, check_bag
from tests.data.recorded import by_mcap_ros2, by_rosbags, record

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
    found, at = [], 8
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
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20 if LONG else 3))
def test_a_kill_loses_a_second_at_most_and_two_readers_open_what_is_recovered(tmp_path, seed):
    path = tmp_path / "run.mcap"
    with process(path) as running:
        lines = [running.stdout.readline()]
        time.sleep(random.Random(seed).uniform(0.7, 2.7))
        running.kill()
        lines += running.stdout.read().splitlines()
    times = [float(line.split()[1]) for line in lines if len(line.split()) == 2]
    recovery = recover(path, tmp_path / "saved.mcap")
    assert recovery.damages
    for role in (COMMAND, JOINT, WRENCH):
        assert times[-1] - times[recovery.messages[role] - 1] <= 1.0
    first, second = by_rosbags(tmp_path / "saved.mcap"), by_mcap_ros2(tmp_path / "saved.mcap")
    assert first == second
    assert [row[3] for row in first[JOINT]] == list(range(recovery.messages[JOINT]))
    assert not recover(tmp_path / "saved.mcap", tmp_path / "again.mcap").damages


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the limit is one of POSIX")
def test_a_full_disk_is_told_and_what_was_written_recovers(tmp_path):
    path = tmp_path / "run.mcap"
    with process(path, 100_000) as running:
        out, failure = running.communicate(timeout=60)
    assert "File too large; what was written stays" in failure
    assert path.stat().st_size == 100_000
    recovery = recover(path, tmp_path / "saved.mcap")
    assert 0.9 * 100_000 / 550 < recovery.messages[WRENCH] <= len(out.splitlines())
    assert by_rosbags(tmp_path / "saved.mcap") == by_mcap_ros2(tmp_path / "saved.mcap")


def test_a_whole_bag_is_said_to_be_whole_and_nothing_is_written(bag, tmp_path):
    recovery = recover(bag, tmp_path / "saved.mcap")
    assert recovery.whole
    assert recovery.messages[JOINT] == 250
    assert recovery.seconds == pytest.approx(2.49, abs=1e-6)
    assert not (tmp_path / "saved.mcap").exists()
    check_bag(bag)


def test_of_a_cut_chunk_every_whole_message_is_saved_and_the_original_stays(bag, damaged, tmp_path):
    (_, end), *_ = chunks(bag.read_bytes())
    path = damaged(lambda data: data[: end - 1000])
    before = path.read_bytes()
    recovery = recover(path, tmp_path / "saved.mcap")
    assert path.read_bytes() == before
    assert 245 <= recovery.messages[COMMAND] < 250
    assert by_rosbags(tmp_path / "saved.mcap")[JOINT] == by_rosbags(bag)[JOINT][: recovery.messages[JOINT]]
    assert 0 < recovery.damages[0].length < 1000


def test_zeros_that_a_power_cut_left_are_no_values(bag, damaged, tmp_path):
    (_, end), *_ = chunks(bag.read_bytes())
    path = damaged(lambda data: data[: end - 5000] + bytes(4000))
    recovery = recover(path, tmp_path / "saved.mcap")
    saved = by_rosbags(tmp_path / "saved.mcap")
    whole = by_rosbags(bag)
    assert 220 <= recovery.messages[JOINT] < 250
    for topic, rows in saved.items():
        assert rows == whole[topic][: len(rows)]


@pytest.fixture
def several(tmp_path):
    """A compressed bag of five chunks, each with messages of its own; the bytes, and the chunks' places."""

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
    assert (damage.start, damage.length) == (places[2][0], places[2][1] - places[2][0])


@pytest.mark.parametrize("length", [3, 400, 10**6, 2**63])
def test_behind_a_length_that_is_wrong_the_next_chunk_is_found(several, length, tmp_path):
    path, data, places = several(CompressionType.ZSTD)
    data[places[1][0] + 1 : places[1][0] + 9] = struct.pack("<Q", length)
    path.write_bytes(data)
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(10), *range(20, 50)]


def test_what_a_wrong_length_of_an_index_skipped_is_found_again(several, tmp_path):
    path, data, places = several(CompressionType.ZSTD)
    index = places[1][1]
    assert data[index] == 7
    data[index + 1 : index + 9] = struct.pack("<Q", places[3][0] + 11 - index)
    path.write_bytes(data)
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(50)]


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
    with pytest.raises(LogError, match="no message in it can be read"):
        recover(path, tmp_path / "saved.mcap")


def test_a_beginning_that_is_gone_costs_the_first_chunk(several, tmp_path):
    path, data, places = several(CompressionType.ZSTD)
    path.write_bytes(data[places[0][0] + 20 :])
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(10, 50)]


def test_an_index_that_is_damaged_is_written_anew(several, tmp_path):
    path, data, _ = several(CompressionType.ZSTD)
    data[-60] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(LogError, match="softfin bag recover"):
        check_bag(path)
    recover(path, tmp_path / "saved.mcap")
    assert numbers(tmp_path / "saved.mcap") == [*range(50)]


def chunk(data: bytes, compression: bytes, expected: int, checksum: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, expected, checksum)
    content = head + struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(content)) + content


@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_a_bomb_goes_off_nowhere(bag, tmp_path, compression):
    import tracemalloc

    import lz4.frame
    import zstandard

    size = 4 * bag_scan.LARGEST
    compress = zstandard.compress if compression == b"zstd" else lz4.frame.compress
    bomb = compress(bytes(size))
    begin = bag.read_bytes()[: chunks(bag.read_bytes())[0][1]]
    tracemalloc.start()
    for expected in (size, 1000):
        (tmp_path / "bomb.mcap").write_bytes(begin + chunk(bomb, compression, expected, 0))
        recovery = recover(tmp_path / "bomb.mcap", tmp_path / f"saved-{expected}.mcap")
        assert recovery.messages[JOINT] == 250
        with pytest.raises(LogError, match="truncated, or no ROS 2 bag"):
            read_bag(tmp_path / "bomb.mcap", "bomb", "train", ImportConfig())
    assert tracemalloc.get_traced_memory()[1] < 2 * bag_scan.LARGEST
    tracemalloc.stop()


def test_many_small_bombs_are_no_recording(tmp_path):
    import zstandard

    record_of_zeros = struct.pack("<BQ", 0x80, 2**20 - 9) + bytes(2**20 - 9)
    piece = chunk(zstandard.compress(record_of_zeros), b"zstd", 2**20, zlib.crc32(record_of_zeros))
    (tmp_path / "bombs.mcap").write_bytes(bag_scan.MAGIC + 200 * piece)
    for read in (check_bag, lambda path: recover(path, tmp_path / "saved.mcap")):
        with pytest.raises(LogError, match="inflates to more than 200 times its size"):
            read(tmp_path / "bombs.mcap")


def compressed(data: bytes, checksum: int | None = None) -> bytes:
    import zstandard

    return chunk(zstandard.compress(data), b"zstd", len(data), zlib.crc32(data) if checksum is None else checksum)


TINY = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)


def test_more_records_than_a_file_has_room_for_are_no_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_chunks, "RECORDS", 1000)
    monkeypatch.setattr(bag_scan, "COUNTED", 100)
    (tmp_path / "tiny.mcap").write_bytes(bag_scan.MAGIC + 3 * compressed(50_000 * TINY))
    seen = itertools.count()
    with pytest.raises(LogError, match=r"has over 1,\d{3} records in \d{3} bytes: it is no recording"):
        deque(zip(BagScan(tmp_path / "tiny.mcap").records(), seen, strict=False), 0)
    most = 1000 + (tmp_path / "tiny.mcap").stat().st_size // mcap_chunks.RECORD_BYTES
    assert next(seen) <= most + bag_scan.COUNTED


@pytest.mark.parametrize("hidden", [False, True])
def test_chunks_that_come_to_nothing_are_inflated_only_so_often(tmp_path, monkeypatch, hidden):
    """Hidden in what nobody reads, they are met only by the search behind a damage."""
    monkeypatch.setattr(mcap_chunks, "LARGEST", 2**20)
    bombs = 2000 * compressed(bytes(100_000), checksum=1)
    if hidden:
        bombs = struct.pack("<BQ", 0x80, len(bombs)) + bombs + bytes(9)
    (tmp_path / "bombs.mcap").write_bytes(bag_scan.MAGIC + bombs)
    inflated, lengths = mcap_chunks.inflated, []
    monkeypatch.setattr(bag_scan, "inflated", lambda data: lengths.append(100_000) or inflated(data))
    with pytest.raises(LogError, match="inflates to more than 200 times its size"):
        check_bag(tmp_path / "bombs.mcap")
    assert sum(lengths) <= 2**20 + mcap_chunks.GROWTH * (tmp_path / "bombs.mcap").stat().st_size


def test_records_in_no_chunk_are_read_many_at_a_time(tmp_path, monkeypatch):
    (tmp_path / "loose.mcap").write_bytes(bag_scan.MAGIC + 20_000 * TINY)
    read, calls = bag_scan._read, []
    monkeypatch.setattr(bag_scan, "_read", lambda *what: calls.append(what) or read(*what))
    assert sum(1 for opcode, _ in BagScan(tmp_path / "loose.mcap").records() if opcode == 5) == 20_000
    assert len(calls) < 100


def test_a_search_reads_what_it_has_read_no_second_time(tmp_path, monkeypatch):
    record = struct.pack("<BQ", 0x80, 9) + bytes(9)
    broken = compressed(record) + b"\xff" * 9
    (tmp_path / "broken.mcap").write_bytes(bag_scan.MAGIC + 500 * broken)
    read, lengths = bag_scan._read, []
    monkeypatch.setattr(bag_scan, "_read", lambda *what: lengths.append(what[2]) or read(*what))
    scan = BagScan(tmp_path / "broken.mcap")
    assert sum(1 for opcode, _ in scan.records() if opcode) == 500
    assert lengths.count(max(lengths)) == 1


@pytest.mark.parametrize("content", [b"", bag_scan.MAGIC, bag_scan.MAGIC + compressed(10 * TINY)])
def test_holes_of_a_sparse_file_are_not_read(tmp_path, monkeypatch, content):
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as file:
        file.write(content)
        file.truncate(20 * 2**30)
        if mcap_chunks.bytes_held(file, 20 * 2**30) > 2**20:
            pytest.skip("a file system without holes")
    read, lengths = bag_scan._read, []
    monkeypatch.setattr(bag_scan, "_read", lambda *what: lengths.append(what[2]) or read(*what))
    scan = BagScan(path)
    assert sum(1 for opcode, _ in scan.records() if opcode) == (10 if len(content) > 8 else 0)
    assert scan.damages
    assert sum(lengths) < 4 * 2**20


def test_chunks_of_holes_are_no_recording(tmp_path):
    """Without a checksum, zeros that are on no disk could be taken for records of any length."""
    path, length = tmp_path / "sparse.mcap", 2**25
    head = chunk(b"", b"", length, 0)[9:-8] + struct.pack("<Q", length)
    with path.open("wb") as file:
        file.write(bag_scan.MAGIC)
        for _ in range(8):
            file.write(struct.pack("<BQ", 6, len(head) + length) + head)
            file.seek(length, os.SEEK_CUR)
        file.truncate()
        if mcap_chunks.bytes_held(file, file.tell()) > 2**20:
            pytest.skip("a file system without holes")
    with pytest.raises(LogError, match="it is no recording"):
        check_bag(path)


def test_what_is_no_bag_is_refused_in_one_line(tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_bytes(b"time,angle\n" * 1000)
    for name in ("empty.mcap", "text.mcap", "none.mcap"):
        with pytest.raises(LogError) as error:
            recover(tmp_path / name, tmp_path / "saved.mcap")
        assert str(error.value).startswith(str(tmp_path / name))
        assert "\n" not in str(error.value)
    with pytest.raises(LogError, match=r"a folder; give the \.mcap file"):
        recover(tmp_path, tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()


def test_nothing_is_overwritten_unless_it_is_said_and_never_the_original(damaged, tmp_path):
    path = damaged(lambda data: data[:-1])
    out = recovered_path(path)
    assert out.name == "harmed.recovered.mcap"
    recover(path, out)
    with pytest.raises(LogError, match="exists already"):
        recover(path, out)
    recover(path, out, overwrite=True)
    with pytest.raises(LogError, match="exists already"):
        recover(path, path, overwrite=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["harmed.mcap", "harmed.recovered.mcap"]


def test_more_definitions_than_any_recording_has_are_refused(bag, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_recovery, "DEFINITIONS_BYTES", 1000)
    with pytest.raises(LogError, match="of definitions: no recording"):
        recover(bag, tmp_path / "saved.mcap")


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Bytes changed, cut out, repeated, lengths forged; sometimes with the chunk's checksum set right again."""
    found = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(found))
        kind = rng.randrange(6)
        if kind == 0:
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            found[at : at + rng.choice((2, 4, 8))] = rng.choice((b"\xff", b"\0", b"\x7f")) * rng.choice((2, 4, 8))
        elif kind == 2:
            del found[at : at + rng.randint(1, 200)]
        elif kind == 3:
            found[at:at] = found[rng.randrange(len(found)) :][: rng.randint(1, 100)]
        elif kind == 4:
            del found[at:]
        else:
            found[at : at + 8] = struct.pack("<Q", rng.choice((2**63, 2**40, 2**32 - 1, 2**31, len(found), 0, 1)))
        found = found or bytearray(b"\x89")
    if rng.random() < 0.5:
        for start, end in chunks(bytes(found)):
            if end <= len(found) and end - start >= 49:
                found[start + 33 : start + 37] = struct.pack("<I", zlib.crc32(found[start + 49 : end]))
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
    path, out = folder / "case.mcap", folder / "saved.mcap"
    counts = Counter()
    config = ImportConfig()
    slowest = 0.0
    for seed in range(100_000 if LONG else 300):
        path.write_bytes(mutated(small, random.Random(seed)))
        start = time.perf_counter()
        counts["recovered", refusal(lambda: recover(path, out)) is None] += 1
        for one in (path, out):
            if one.exists():
                complaint = refusal(lambda one=one: logs_of(read_bag(one, one.name, "train", config), config))
                assert complaint is None or complaint.isprintable(), seed
                counts["read", complaint is None] += 1
        slowest = max(slowest, time.perf_counter() - start)
        out.unlink(missing_ok=True)
        assert [file.name for file in folder.iterdir()] == ["case.mcap"], seed
    assert len(counts) == 4, counts
    assert slowest < 20
    assert sorted(file.name for file in tmp_path.iterdir()) == ["small.mcap", "target"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the limit is one of POSIX")
def test_mutations_are_read_in_little_memory(tmp_path):
    """In a process that may have no more than it needs and 64 MiB above what a chunk may."""
    small = record(tmp_path / "small.mcap", rows=6)
    script = f"""
import random, resource, sys
from pathlib import Path
from softfin.core.errors import SoftfinError
from softfin.storage.bag.recovery import recover
from tests.storage.bag.test_recovery import mutated
pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 2**20
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**26 + 2**27,) * 2)
data = Path({str(small)!r}).read_bytes()
path, out = Path({str(tmp_path / "case.mcap")!r}), Path({str(tmp_path / "saved.mcap")!r})
for seed in range({20_000 if LONG else 200}):
    path.write_bytes(mutated(data, random.Random(-seed)))
    try:
        recover(path, out, overwrite=True)
    except SoftfinError:
        pass
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-1000:]
