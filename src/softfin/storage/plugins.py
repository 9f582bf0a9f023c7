"""Parts of softfin that other packages can add to, such as devices and surrogates, by name."""

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points


def list_plugins(group: str, own: Mapping[str, str]) -> dict[str, EntryPoint]:
    """Return the parts by name: softfin's own, given as ``package.module:OBJECT``, then those of
    the entry points of installed packages.

    An entry point with the name of one of softfin's own is ignored, so that no package replaces it
    by accident. Nothing is imported before `EntryPoint.load`.
    """
    found = {name: EntryPoint(name, value, group) for name, value in own.items()}
    for entry_point in entry_points(group=group):
        found.setdefault(entry_point.name, entry_point)
    return found
