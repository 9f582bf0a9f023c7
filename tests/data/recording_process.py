"""A process that records rows at 100 Hz until it is killed or its recording fails, and says each
row that it hands in.

``python -m tests.data.recording_process BAG [LARGEST_FILE_BYTES]``; a line a row: its number and
its time.
"""

import os
import sys
import time
from pathlib import Path

from softfin.storage.bag.writer import BagRecorder
from tests.patience import HANG_S


def main() -> None:
    recorder = BagRecorder(Path(sys.argv[1]))
    if len(sys.argv) > 2:
        import resource
        import signal

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
    start = time.monotonic()
    k = 0
    while recorder.failure is None and time.monotonic() < start + HANG_S:
        now = time.monotonic()
        recorder.command(now, float(k), 1.0)
        recorder.joint(now, float(k), 0.0, 0.5)
        recorder.wrench(now, (float(k), 0.0, 0.0, 0.0, 0.0, 0.0))
        os.write(1, f"{k} {now:.6f}\n".encode())
        k += 1
        time.sleep(max(0.0, start + k / 100 - time.monotonic()))
    recorder.close()
    sys.stderr.write(f"{recorder.failure}\n")


main()
