import json
import os
import signal
import subprocess
import sys
import urllib.request

import pytest

from tests.patience import HANG_S
from tests.rig.monitor.bags import Recording


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(Recording().chunk(50, event="armed").bytes)
    return path


NO_JAX = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jax", "jaxlib"):
            raise ImportError(name)
sys.meta_path.insert(0, Absent())
from softfin.cli import script
script()
"""


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C cannot be sent to one process there")
def test_ctrl_c_ends_the_page_quietly_and_neither_jax_nor_the_recording_is_touched(bag):
    before = bag.stat()
    command = [sys.executable, "-c", NO_JAX, "monitor", str(bag), "--port", "0"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stderr.readline().split()[0]
        with urllib.request.urlopen(address + "data?since=0", timeout=HANG_S) as answer:
            assert json.load(answer)["summary"]["path"] == str(bag)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=HANG_S)
    finally:
        process.kill()
    assert (process.returncode, said) == (0, "")
    assert (bag.stat().st_mtime_ns, bag.stat().st_size) == (before.st_mtime_ns, before.st_size)
