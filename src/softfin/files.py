"""Files that a user names, looked at before they are opened: a pipe would be waited for, and a device has no end."""

import errno
import stat
from pathlib import Path

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def regular_file(path: Path) -> Path:
    """Return `path` where it is a regular file or a link to one; raises OSError, without opening it, for all else."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        code = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
        raise OSError(code, f"{_KINDS.get(stat.S_IFMT(mode), 'something else')}, not a file", str(path))
    return path
