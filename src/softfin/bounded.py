"""Files that somebody else made, read with an end in sight: sizes are looked at before anything is read or built."""

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

DEEPEST = 64
"""Levels of JSON; softfin writes about ten."""


def check_file(path: Path, largest: int) -> int:
    """The size of a regular file [bytes]; raises OSError for anything else, and for more than `largest`."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        # A pipe would be waited for, a device has no end.
        code = errno.EISDIR if stat.S_ISDIR(found.st_mode) else errno.EINVAL
        raise OSError(code, "a folder, not a file" if code == errno.EISDIR else "not a regular file", str(path))
    if found.st_size > largest:
        raise _too_large(path, largest)
    return found.st_size


def read_bytes(path: Path, largest: int) -> bytes:
    """The whole of a file; raises OSError where it holds more than `largest` bytes."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        data = b"" if size > largest else file.read(largest + 1)
    if max(size, len(data)) > largest:
        raise _too_large(path, largest)
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


def _too_large(path: Path, largest: int) -> OSError:
    return OSError(errno.EFBIG, f"it has over {largest:,} bytes", str(path))
