"""A disk that fills up while a run writes its training log."""

import itertools
from pathlib import Path

import pytest

from softfin.core.errors import RunError
from softfin.storage.run_directory import CHECKPOINT, RunLog

FULL = Path("/dev/full")
needs_full_device = pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")


def fill(file):
    """Replace a file with a link to a device that is always full."""
    file.unlink()
    file.symlink_to(FULL)


def check_that_a_full_disk_stops(job, work):
    """Check that a job that writes to the folder `work` ends with an error if the disk is full at
    the third log entry, and keeps its checkpoint."""
    write = RunLog.write
    entries = itertools.count(1)

    def write_until_full(log, step, **scalars):
        if next(entries) == 3:
            fill(log.path)
        write(log, step, **scalars)

    message = r"log.jsonl: cannot be written \(No space left on device\); free disk space, then"
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr(RunLog, "write", write_until_full)
        with pytest.raises(RunError, match=message):
            job()
    assert (work / CHECKPOINT).is_file()
