"""A lock that lets only one process at a time write to an output folder.

Two runs with the same output would delete each other's unfinished work. Each run therefore locks
the file ``.NAME.lock`` next to the output; the output itself is replaced during a run. The file is
removed when the run ends. If a process is killed, the file remains but is no longer locked.
"""

import contextlib
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import ParamSpec, TypeVar

from softfin.core.errors import ArtifactError
from softfin.core.file_lock import describe_holder, lock_file, unlock_file

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def lock_output(stage: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function so that it locks the folder given by its argument `out` while it runs.

    The function raises ArtifactError if another run holds the lock. On a file system without locks,
    it runs without one.
    """
    parameters = signature(stage)

    @wraps(stage)
    def run(*args: Arguments.args, **options: Arguments.kwargs) -> Result:
        # Resolve links, because a folder can have several names.
        out = Path(parameters.bind(*args, **options).arguments["out"]).resolve()
        path = out.with_name(f".{out.name}.lock")
        missing = [folder for folder in path.parents if not folder.exists()]
        descriptor = _lock(out, path)
        try:
            return stage(*args, **options)
        finally:
            if descriptor is not None:
                # Remove the file while it is still locked so that no other process can hold the
                # lock.
                with contextlib.suppress(OSError):
                    path.unlink()
                unlock_file(descriptor)
            # Remove the folders that were created for the lock and are still empty.
            with contextlib.suppress(OSError):
                for folder in missing:
                    folder.rmdir()

    return run


def _lock(out: Path, path: Path) -> int | None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return lock_file(path)
    except BlockingIOError:
        raise ArtifactError(
            f"{out}: in use by another softfin run{describe_holder(path)}; wait until it ends, or "
            "set a different --out"
        ) from None
    except (OSError, ImportError):
        # Run without a lock. If the folder cannot be written, the run reports the problem.
        return None
