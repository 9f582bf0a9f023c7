"""Files that a user names, read with an end in sight: kind and size are looked at before anything is opened."""

import errno
import json
import stat
from pathlib import Path
from typing import Any

DEEPEST = 64
"""Levels of JSON; softfin writes about ten."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def regular_file(path: Path, largest: int | None = None) -> Path:
    """Return `path` where it is a regular file or a link to one, of at most `largest` bytes.

    Raises OSError, without opening it, for all else: a pipe would be waited for, and a device has no end.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        code = errno.EISDIR if stat.S_ISDIR(found.st_mode) else errno.EINVAL
        raise OSError(code, f"{_KINDS.get(stat.S_IFMT(found.st_mode), 'something else')}, not a file", str(path))
    if largest is not None and found.st_size > largest:
        raise OSError(errno.EFBIG, f"it has over {largest:,} bytes", str(path))
    return path


def read_bytes(path: Path, largest: int) -> bytes:
    """The whole of a regular file; raises OSError where it holds more than `largest` bytes."""
    with regular_file(path, largest).open("rb") as file:
        data = file.read(largest + 1)
    if len(data) > largest:
        raise OSError(errno.EFBIG, f"it has over {largest:,} bytes", str(path))
    return data


def parse_json(text: str | bytes) -> Any:
    """A JSON value; raises ValueError for anything else, and for one that is nested deeper than `DEEPEST` levels."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise _too_deep() from None
    level = [value]
    for _ in range(DEEPEST):
        level = [inner for outer in level for inner in _inner(outer)]
        if not level:
            return value
    raise _too_deep()


def _inner(value: Any) -> list[Any]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [each for each in inner if isinstance(each, dict | list)]


def _too_deep() -> ValueError:
    return ValueError(f"brackets within brackets, more than {DEEPEST} deep")
