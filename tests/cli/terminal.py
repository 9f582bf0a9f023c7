"""The command line on a terminal: a process whose standard input is a pty, which the test types
into."""

import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.patience import HANG_S

ROOT = Path(__file__).parents[2]


class Terminal:
    """A context; the process is gone at its end."""

    def __init__(self, words: Sequence[object], folder: Path) -> None:
        self._master, slave = pty.openpty()
        environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "COLUMNS": "200"}
        # Tests that run under nohup would pass its ignored SIGHUP on.
        hangup = signal.signal(signal.SIGHUP, signal.SIG_DFL)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "softfin.cli", *map(str, words)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
        signal.signal(signal.SIGHUP, hangup)
        os.close(slave)
        self.said = ""

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._master)

    def wait_for(self, words: str) -> None:
        """Until it says that."""
        deadline = time.monotonic() + HANG_S
        while words not in self.said:
            assert self._read(deadline), f"ended without {words!r}: {self.said}"

    def type(self, text: str) -> None:
        os.write(self._master, text.encode())

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def ended(self) -> int:
        """Its exit code, with all that it said read."""
        deadline = time.monotonic() + HANG_S
        while self._read(deadline):
            pass
        return self._process.wait(timeout=HANG_S)

    def _read(self, deadline: float) -> bool:
        ready, _, _ = select.select([self._master], [], [], max(0.0, deadline - time.monotonic()))
        assert ready, f"nothing more is said: {self.said}"
        try:
            data = os.read(self._master, 65536)
        except OSError:
            return False
        self.said += data.decode(errors="replace").replace("\r\n", "\n")
        return bool(data)


CTRL_C = signal.SIGINT
