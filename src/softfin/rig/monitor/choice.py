"""Which bag to follow: the one that was named, or the newest of a folder."""

from pathlib import Path

PATTERNS = ("*.mcap", "*/*.mcap", "*/*/*.mcap")
"""A folder of bags, of bag folders, or of runs that hold them; no deeper, for a monitor should not read whole disks."""

NEWER_S = 1.0
"""So much later must another bag have been written to: two recordings at once do not take turns."""


def newest(folder: Path, followed: Path | None) -> Path | None:
    """The bag that was written to last; the followed one as long as no other is clearly newer."""
    times: dict[Path, float] = {}
    for pattern in PATTERNS:
        for path in folder.glob(pattern):
            try:
                if path.is_file() and not path.name.startswith("."):
                    times[path] = path.stat().st_mtime
            except OSError:
                # Renamed or removed meanwhile.
                continue
    if not times:
        return followed
    best = max(times, key=lambda path: (times[path], path.name))
    if followed in times and times[best] <= times[followed] + NEWER_S:
        return followed
    return best
