"""A lock that permits only one program on this computer to use a device at a time, and only once
per program.

A second program would take over the sensor stream from the first program, which would then stop its
fin and suggest checking the cable. The lock is an advisory file lock (flock); the kernel releases
it when the program ends for any reason. The file is never removed, because two programs could then
lock two different files with the same name.
"""

import contextlib
import os
import re
import signal
import stat
import tempfile
from pathlib import Path

from softfin.core.clock import Clock
from softfin.core.errors import RigError
from softfin.core.file_lock import describe_holder, find_holder, lock_file, unlock_file

LOCK_FOLDER = Path("/run/lock")
"""Folder for device locks on Linux (FHS 3.0), often writable by all users."""

SHARED_FOLDER = Path("/tmp")
"""Folder for device locks if some users cannot write to `LOCK_FOLDER`; TMPDIR is not used, because
it may differ between users."""

TAKE_OVER_S = 3.0
"""Time for which `DeviceLock.take_over` waits for the other program to stop its fin and end [s].
Stopping a Dynamixel with late answers takes more than a second."""

TAKE_OVER_STEP_S = 0.02


class DeviceLock:
    """Lock for one device; `device` is its name in messages, and `key` must be the same in every
    program that uses the device."""

    def __init__(self, device: str, *key: object) -> None:
        self._device = device
        # The key contains names from a file, which must not escape from the lock folder.
        self._file = f"softfin-{re.sub(r'[^A-Za-z0-9.]+', '_', '-'.join(map(str, key)))[:150]}"
        self._descriptor: int | None = None
        self.note: str | None = None
        """Note that the device cannot be locked on this computer; None if it can be locked."""

    def acquire(self, clock: Clock) -> None:
        """Acquire the lock unless this object already holds it; raises RigError if a different
        program holds the lock.

        A device on a simulated clock exists only in this process and is not locked.
        """
        if self._descriptor is not None or clock.is_simulated:
            return
        self.note = None
        path = _folder() / self._file
        try:
            self._descriptor = lock_file(path)
        except BlockingIOError:
            raise RigError(
                f"{self._device}: in use by another program{describe_holder(path)}; "
                "close that program first"
            ) from None
        except (OSError, ImportError) as error:
            # Without locks, the fin can still be used, but the user must avoid conflicts.
            self.note = (
                f"{self._device}: cannot be locked ({error}); make sure that no other program "
                "uses it"
            )

    def take_over(self, clock: Clock) -> bool:
        """If a different program holds the lock, send SIGTERM so that it stops its fin and ends,
        and wait `TAKE_OVER_S` for the lock; return whether the lock is acquired."""
        end = clock() + TAKE_OVER_S
        is_asked = False
        while True:
            try:
                self.acquire(clock)
                return True
            except RigError:
                if clock() >= end:
                    return False
            if not is_asked:
                is_asked = self._ask_holder()
            clock.sleep(TAKE_OVER_STEP_S)

    def _ask_holder(self) -> bool:
        """Send SIGTERM to the program that holds the lock; return whether there is such a
        program."""
        path = _folder() / self._file
        process = find_holder(path)
        with contextlib.suppress(OSError):
            if process not in (None, os.getpid()) and _has_open(process, path):
                os.kill(process, signal.SIGTERM)
                return True
        return False

    def release(self) -> None:
        """Release the lock; may be called repeatedly and never raises."""
        descriptor = self._descriptor
        self._descriptor = None
        if descriptor is not None:
            unlock_file(descriptor)


def _folder() -> Path:
    """Return the folder for locks; it must be the same for all users, because they would not see
    each other's locks otherwise."""
    with contextlib.suppress(OSError):
        if LOCK_FOLDER.stat().st_mode & stat.S_IWOTH:
            return LOCK_FOLDER
    return SHARED_FOLDER if SHARED_FOLDER.is_dir() else Path(tempfile.gettempdir())


def _has_open(process: int, path: Path) -> bool:
    """Return whether a process has a file open; the process ID in a lock file may be outdated and
    belong to an unrelated process.

    Returns False if this is unknown, because there is no /proc or the process belongs to a
    different user.
    """
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            # `stat` is not used because it would hang for a file on a disconnected network drive.
            with contextlib.suppress(OSError):
                if descriptor.readlink() == path.resolve():
                    return True
    return False
