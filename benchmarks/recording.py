"""Messages a second that the recorder takes to the disk, against the need; and what handing a row
in costs the loop.

Beside them, in turn with the recorder: how fast the same disk takes the same bytes in one plain
write with a synchronisation, and how many messages a second that would be.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from benchmarks.measure import entry
from softfin.storage.bag.writer import BACKLOG, BagRecorder

NEED = 400
"""Messages a second: command, joint, current and wrench at 100 Hz."""

ROWS = 10_000
"""Of four messages each: all wait at once, below the recorder's `BACKLOG`."""

SECONDS = 10
"""Of the loop at 100 Hz whose hand-in is timed."""

REPEATS = 5


def main() -> list[dict[str, Any]]:
    assert 4 * ROWS < BACKLOG
    with tempfile.TemporaryDirectory(dir=os.environ.get("SOFTFIN_BENCHMARK_DISK")) as folder:
        recorded = []
        plain = []
        for number in range(REPEATS):
            path = Path(folder) / f"{number}.mcap"
            recorded.append(_record(path))
            size = path.stat().st_size
            plain.append(_write(Path(folder) / f"{number}.bytes", size))
        hand_in = _hand_in(Path(folder) / "loop.mcap")
    rate = 4 * ROWS / statistics.median(recorded)
    disk = size / statistics.median(plain)
    return [
        entry(
            "recording, messages to the disk",
            rate / NEED,
            "x the need",
            50,
            messages_per_s=rate,
            need_per_s=NEED,
            bytes_per_message=size / (4 * ROWS),
        ),
        entry(
            "plain write of the same bytes",
            disk / (size / (4 * ROWS)) / NEED,
            "x the need",
            50,
            disk_mb_per_s=disk / 1e6,
            recorder_mb_per_s=size / statistics.median(recorded) / 1e6,
        ),
        entry(
            "row handed in by the loop, p99",
            1e6 * _quantile(hand_in, 0.99),
            "us",
            200,
            at_least=False,
            median_us=1e6 * statistics.median(hand_in),
            worst_us=1e6 * max(hand_in),
        ),
    ]


def _record(path: Path) -> float:
    """From the first row to the file's end on the disk [s]."""
    recorder = BagRecorder(path)
    start = time.perf_counter()
    for k in range(ROWS):
        _row(recorder, k / 100)
    recorder.close()
    spent = time.perf_counter() - start
    assert recorder.failure is None
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 4 * ROWS
    return spent


def _write(path: Path, size: int) -> float:
    data = os.urandom(size)
    start = time.perf_counter()
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return time.perf_counter() - start


def _hand_in(path: Path) -> list[float]:
    recorder = BagRecorder(path)
    spent = []
    begin = time.monotonic()
    for k in range(SECONDS * 100):
        time.sleep(max(0.0, begin + k / 100 - time.monotonic()))
        start = time.perf_counter()
        _row(recorder, time.monotonic())
        spent.append(time.perf_counter() - start)
    recorder.close()
    return spent


def _row(recorder: BagRecorder, now: float) -> None:
    recorder.command(now, 0.5, 2.0)
    recorder.joint(now, 0.4, 1.0, 0.3)
    recorder.wrench(now, (0.5, -0.25, 0.1, 0.01, 0.02, 0.03))


def _quantile(values: list[float], share: float) -> float:
    return sorted(values)[int(share * len(values))]
