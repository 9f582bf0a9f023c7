"""A lock that lets only one program on this computer use a device at a time, and only once per
program.

A second program on the same sensor would take the stream away from the first, which would then stop
its fin and blame the cable. The lock is an advisory lock (flock) on a file; the kernel releases it
when the program ends for any reason. The file is never removed, because two programs could then
lock two different files of the same name.
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
"""Folder for device locks on Linux (FHS 3.0), often writable by every user."""

SHARED_FOLDER = Path("/tmp")
"""Folder for device locks if some users cannot write to `LOCK_FOLDER`; TMPDIR is not used, because
it may differ between users."""

TAKE_OVER_S = 3.0
"""Time for which `DeviceLock.take_over` waits for the other program to stop its fin and end [s].
The stop of a Dynamixel whose answers are late takes more than a second."""

TAKE_OVER_STEP_S = 0.02


class DeviceLock:
    """Lock for one device; `device` is its name in messages, and `key` must be the same in every
    program that uses it."""

    def __init__(self, device: str, *key: object) -> None:
        self._device = device
        # The key contains names from a file, which must not escape from the lock folder.
        self._file = f"softfin-{re.sub(r'[^A-Za-z0-9.]+', '_', '-'.join(map(str, key)))[:150]}"
        self._descriptor: int | None = None
        self.note: str | None = None
        """Note that the device cannot be locked on this computer; None if it can."""

    def acquire(self, clock: Clock) -> None:
        """Acquire the lock unless it is already held; raises RigError if another program holds it.

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
            # Without locks the fin can still be used, but the user has to avoid conflicts.
            self.note = (
                f"{self._device}: cannot be locked ({error}); make sure that no other program "
                "uses it"
            )

    def take_over(self, clock: Clock) -> bool:
        """Ask another program that holds the lock to stop its fin and end (SIGTERM), and wait
        `TAKE_OVER_S` for the lock; return whether it is acquired."""
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
        """Send SIGTERM to the program that holds the lock; return whether there was one."""
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
    """Return the folder for locks; it must be the same for all users, or they would not see each
    other's locks."""
    with contextlib.suppress(OSError):
        if LOCK_FOLDER.stat().st_mode & stat.S_IWOTH:
            return LOCK_FOLDER
    return SHARED_FOLDER if SHARED_FOLDER.is_dir() else Path(tempfile.gettempdir())


def _has_open(process: int, path: Path) -> bool:
    """Return whether a process has a file open; the process ID in a lock file may be outdated and
    belong to an unrelated process.

    False if this is unknown: there is no /proc, or the process belongs to a different user.
    """
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            # Not by `stat`, which would hang for a file on a network drive that is gone.
            with contextlib.suppress(OSError):
                if descriptor.readlink() == path.resolve():
                    return True
    return False
