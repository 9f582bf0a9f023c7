"""A lock that lets only one process at a time write to an output folder.

Two runs with one output would delete each other's unfinished work. The lock is on the file
``.NAME.lock`` next to the output, because the output and the unfinished work are replaced during a
run. It is removed when the run ends; a file that a killed process left behind is not locked.
"""

import contextlib
import os
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import ParamSpec, TypeVar

from softfin.core.errors import ArtifactError
from softfin.core.file_lock import describe_holder, lock_file

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def lock_output(stage: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function that writes to its argument `out`: it holds the lock of this folder while
    it runs.

    The function raises ArtifactError if another process holds the lock. On a file system without
    locks, it runs without one.
    """
    parameters = signature(stage)

    @wraps(stage)
    def run(*args: Arguments.args, **options: Arguments.kwargs) -> Result:
        # Resolved, because links can give one folder several names.
        out = parameters.bind(*args, **options).arguments["out"].resolve()
        path = out.with_name(f".{out.name}.lock")
        descriptor = _lock(out, path)
        try:
            return stage(*args, **options)
        finally:
            if descriptor is not None:
                # Removed while it is locked, so no other process can hold it.
                with contextlib.suppress(OSError):
                    path.unlink()
                os.close(descriptor)

    return run


def _lock(out: Path, path: Path) -> int | None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return lock_file(path)
    except BlockingIOError:
        raise ArtifactError(
            f"{out}: another softfin process{describe_holder(path)} is writing to it; wait until "
            "it ends, or choose another --out"
        ) from None
    except (OSError, ImportError):
        # The run works without a lock. If the folder cannot be written, the run reports that.
        return None
