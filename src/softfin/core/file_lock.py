"""Advisory file locks (flock). The kernel releases a lock when its process ends for any reason."""

import contextlib
import os
from pathlib import Path

_open_descriptors: set[int] = set()
"""Descriptors of the lock files that this process has open."""


def lock_file(path: Path) -> int:
    """Create a file if it is missing, lock it, and write this process's ID to it.

    Returns a descriptor for `unlock_file`. The holder of the lock may remove the file. Raises
    BlockingIOError if the file is already locked, and another OSError or ImportError if the system
    does not support locks.
    """
    # Imported here because Windows does not have this module.
    import fcntl

    descriptor = _open(path)
    _open_descriptors.add(descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        unlock_file(descriptor)
        raise
    # The previous holder may have removed the file after it was opened here. Another process could
    # then lock a new file of the same name.
    if os.fstat(descriptor).st_nlink == 0:
        unlock_file(descriptor)
        return lock_file(path)
    # A full disk must not prevent the lock: only messages and `DeviceLock.take_over` need the ID.
    # Its fixed width overwrites any earlier ID.
    with contextlib.suppress(OSError):
        os.pwrite(descriptor, f"{os.getpid():20}\n".encode(), 0)
    return descriptor


def unlock_file(descriptor: int) -> None:
    """Release a lock of this process; has no effect in a forked child."""
    if descriptor in _open_descriptors:
        _open_descriptors.remove(descriptor)
        with contextlib.suppress(OSError):
            os.close(descriptor)


def _leave_to_parent() -> None:
    """Close the descriptors in a forked child, which would otherwise hold the locks after its
    parent has ended."""
    for descriptor in list(_open_descriptors):
        unlock_file(descriptor)


# Windows does not have this function.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def find_holder(path: Path) -> int | None:
    """Return the ID of the process that locked a file; None if the ID is unknown."""
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text(errors="replace"))
    return None


def describe_holder(path: Path) -> str:
    """Return `` (process NUMBER)`` for the process that locked a file, or an empty string if the ID
    is unknown."""
    process = find_holder(path)
    return "" if process is None else f" (process {process})"


def _open(path: Path) -> int:
    """Open a lock file, possibly created by another user, but never through a symbolic link."""
    try:
        # Without O_CREAT, which Linux rejects for files of other users in a shared folder
        # (fs.protected_regular).
        return os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        # The umask would deny other users access to the file.
        os.fchmod(descriptor, 0o666)
        return descriptor
