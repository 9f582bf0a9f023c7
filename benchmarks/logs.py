"""Processor time and memory of the import of a CSV file of 2,000,000 rows, against the time that
Arrow takes to read the numbers, and against the size of the file."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import entry

ROWS = 2_000_000
RATE_HZ = 1000

IMPORT = """
import sys
from pathlib import Path
from softfin.data.importing.importing import ImportConfig
from softfin.data.recordings import open_logs
open_logs(Path(sys.argv[1]), ImportConfig(velocity_rad_s=3.1))
"""

READ = """
import sys
import pyarrow.csv
pyarrow.csv.read_csv(sys.argv[1], pyarrow.csv.ReadOptions(use_threads=False))
"""

MEASURE = """
import resource
usage = resource.getrusage(resource.RUSAGE_SELF)
print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)
"""


def write_recording(path: Path) -> None:
    """A fin that follows a command which changes twice per second, and forces with noise."""
    random = np.random.default_rng(0)
    time_s = np.arange(ROWS) / RATE_HZ
    command = np.repeat(random.uniform(-0.7, 0.7, ROWS // 500 + 1), 500)[:ROWS]
    lag = np.exp(-np.arange(300) / 60)
    angle = np.convolve(command, lag / lag.sum())[:ROWS]
    force = 5 * np.gradient(angle) * RATE_HZ + random.normal(0, 0.01, (2, ROWS))
    columns = np.stack([time_s, command, angle, *force], axis=1)
    names = "time [s],command angle [rad],angle [rad],force x [N],force y [N]"
    np.savetxt(path, columns, "%.6f", ",", header=names, comments="")


def measure(program: str, path: Path) -> tuple[float, float]:
    """Processor time [s] and peak memory [bytes] of a Python program in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program + MEASURE, str(path)],
        check=True,
        capture_output=True,
        text=True,
    )
    processor_s, peak_bytes = map(float, done.stdout.split())
    return processor_s, peak_bytes


def main() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.csv"
        write_recording(path)
        rounds = [(measure(IMPORT, path), measure(READ, path)) for _ in range(3)]
        size = path.stat().st_size
    imports, reads = np.median(rounds, axis=0).tolist()
    name = f"import of {ROWS:,} rows of CSV"
    return [
        entry(
            f"{name}: processor time, relative to reading the numbers with Arrow",
            imports[0] / reads[0],
            "1",
            15,
            at_least=False,
            import_s=imports[0],
            read_s=reads[0],
        ),
        entry(
            f"{name}: peak memory, relative to the file",
            imports[1] / size,
            "1",
            5,
            at_least=False,
            peak_mb=imports[1] / 1e6,
        ),
    ]
