"""One process at a time holds the lock of a file."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from softfin.core.file_lock import describe_holder, lock_file, unlock_file
from tests.patience import HANG_S

ROOT = Path(__file__).parents[2]

HOLDER = """
import os
import sys
from pathlib import Path
from softfin.core.file_lock import lock_file
lock_file(Path(sys.argv[1]))
started, starting = os.pipe()
for _ in sys.argv[2:]:
    if os.fork() == 0:
        os.write(starting, b"x")
        sys.stdin.read()
        os._exit(0)
    # The child has left the lock to its parent.
    os.read(started, 1)
print("locked", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("options", [[], ["with a forked child"]])
def test_a_file_locked_by_another_process_is_refused_until_that_process_is_killed(
    tmp_path, options
):
    path = tmp_path / "lock"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
    )
    try:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(BlockingIOError):
            lock_file(path)
        assert describe_holder(path) == f" (process {holder.pid})"
        holder.kill()
        holder.wait(HANG_S)
        # A forked child lives until its input ends.
        unlock_file(lock_file(path))
        assert describe_holder(path) == f" (process {os.getpid()})"
    finally:
        holder.kill()
        holder.communicate(timeout=HANG_S)


def test_a_file_that_is_removed_before_it_is_locked_is_created_again(tmp_path, monkeypatch):
    path = tmp_path / "lock"
    lock = fcntl.flock
    removals = iter([path.unlink])

    def flock(descriptor, operation):
        lock(descriptor, operation)
        # Only the first time.
        for remove in removals:
            remove()

    monkeypatch.setattr(fcntl, "flock", flock)
    descriptor = lock_file(path)
    with pytest.raises(BlockingIOError):
        lock_file(path)
    unlock_file(descriptor)


@pytest.mark.parametrize("content", ["", "nobody", None])
def test_an_unknown_holder_is_not_in_the_message(tmp_path, content):
    path = tmp_path / "lock"
    if content is not None:
        path.write_text(content)
    assert describe_holder(path) == ""
