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
from softfin.rig.simulated_clock import SimulatedClock

LOCK_FOLDER = Path("/run/lock")
"""Folder for device locks on Linux (FHS 3.0), often writable by every user."""

SHARED_FOLDER = Path("/tmp")
"""Folder for device locks where not every user may write to `LOCK_FOLDER`; not the folder that
TMPDIR names, which may differ between users."""

TAKE_OVER_S = 1.0
"""Time for which `DeviceLock.take_over` waits for the other program to stop its fin and end [s]."""

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
        with contextlib.suppress(OSError):
            number = path.read_text(errors="replace").strip()
            if number.isdecimal() and _has_open(int(number), path):
                os.kill(int(number), signal.SIGTERM)
                return True
        return False

    def release(self) -> None:
        """Release the lock; may be called repeatedly and never raises."""
        descriptor = self._descriptor
        self._descriptor = None
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _lock(self, descriptor: int) -> None:
        try:
            # Imported here because Windows does not have it.
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
            f"{self._device}: cannot be locked ({error}); make sure that no other program uses it"
        )


def _folder() -> Path:
    """Return the same folder for every user, who would otherwise not see each other's locks."""
    with contextlib.suppress(OSError):
        if LOCK_FOLDER.stat().st_mode & stat.S_IWOTH:
            return LOCK_FOLDER
    return SHARED_FOLDER if SHARED_FOLDER.is_dir() else Path(tempfile.gettempdir())


def _has_open(process: int, path: Path) -> bool:
    """Return whether a process has a file open; a number in a file could also be that of a program
    that has ended, or of any other.

    False where this cannot be determined (there is no /proc, or the process is another user's).
    """
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                if descriptor.samefile(path):
                    return True
    return False


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
