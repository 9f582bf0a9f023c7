"""Finds extensible parts of softfin by name, such as devices and surrogates, including those from
other packages."""

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points


def list_plugins(group: str, own: Mapping[str, str]) -> dict[str, EntryPoint]:
    """Return the parts by name: softfin's own parts, given as ``package.module:OBJECT``, and then
    the entry points of installed packages.

    An entry point with the name of one of softfin's own parts is ignored, so that no package can
    replace the part by accident. Nothing is imported before `EntryPoint.load`.
    """
    found = {name: EntryPoint(name, value, group) for name, value in own.items()}
    for entry_point in entry_points(group=group):
        found.setdefault(entry_point.name, entry_point)
    return found
