"""A lock that lets only one program on this computer use a device at a time, and only once in each
program.

A second program on the same drive or sensor would take the stream away from the first, which then
stops its fin and blames the cable. The lock is an advisory one (flock) on a file: the kernel
releases it when the program ends, however it ends. The file stays, because removing it would let
two programs lock two files of the same name.
"""

import contextlib
import os
import re
import tempfile
from pathlib import Path

from softfin.core.clock import Clock
from softfin.core.errors import RigError
from softfin.rig.simulated_clock import SimulatedClock

LOCK_FOLDER = Path("/run/lock")
"""Folder for locks of devices on Linux (FHS 3.0), which every user may write."""


class DeviceLock:
    """The lock of one device; `device` names it in messages, `key` is the same in every program
    that uses it."""

    def __init__(self, device: str, *key: object) -> None:
        self._device = device
        # The key holds names from a file: none of them may lead out of the folder.
        self._file = f"softfin-{re.sub(r'[^A-Za-z0-9.]+', '_', '-'.join(map(str, key)))[:150]}"
        self._descriptor: int | None = None
        self.note: str | None = None
        """Remark that the device cannot be locked here; None if it can."""

    def acquire(self, clock: Clock) -> None:
        """Take the lock, if it is not held already; raises RigError if another program has it.

        A device on a simulated clock exists only within this process, and is not locked.
        """
        if self._descriptor is not None or isinstance(clock, SimulatedClock):
            return
        self.note = None
        try:
            descriptor = _open(_folder() / self._file)
        except OSError as error:
            self._go_without(error)
            return
        try:
            self._lock(descriptor)
        except BaseException:
            os.close(descriptor)
            raise

    def release(self) -> None:
        """Let others use the device; any number of times, never raises."""
        descriptor = self._descriptor
        self._descriptor = None
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _lock(self, descriptor: int) -> None:
        try:
            # Imported here: there is none on Windows.
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            number = os.pread(descriptor, 20, 0).decode(errors="replace").strip()
            process = f" (process {number})" if number.isdecimal() else ""
            raise RigError(
                f"{self._device}: in use by another program on this computer{process}; end it first"
            ) from None
        except (ImportError, OSError) as error:
            os.close(descriptor)
            self._go_without(error)
            return
        self._descriptor = descriptor
        with contextlib.suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)

    def _go_without(self, error: Exception) -> None:
        # Without locks the fin can still be used, but the user has to avoid conflicts.
        self.note = (
            f"{self._device}: cannot be locked ({error}); check that no other program uses it"
        )


def _folder() -> Path:
    return LOCK_FOLDER if os.access(LOCK_FOLDER, os.W_OK) else Path(tempfile.gettempdir())


def _open(path: Path) -> int:
    """Open a lock file, which any user may have created, but never through a symbolic link."""
    try:
        # Without O_CREAT: Linux refuses that for files of other users in a shared folder
        # (fs.protected_regular).
        return os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        # The process's umask would deny other users access to it.
        os.fchmod(descriptor, 0o666)
        return descriptor
