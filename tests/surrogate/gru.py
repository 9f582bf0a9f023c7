"""The example's package with another architecture, installed as a user's would be: by its entry
point, without a change in softfin."""

import functools
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import pytest

from softfin.core.quantities import PAPER_LIMITS
from softfin.surrogate.registry import ENTRY_POINT_GROUP
from tests.documents import ROOT
from tests.surrogate import small

FOLDER = ROOT / "examples/gru"
MODULE = "softfin_gru"


def write_metadata(site: Path, entry_points: dict[str, str]) -> None:
    """What an installer writes of a package."""
    metadata = site / "softfin_gru-0.1.0.dist-info"
    metadata.mkdir(parents=True)
    metadata.joinpath("METADATA").write_text("Name: softfin-gru\nVersion: 0.1.0\n")
    lines = [f"{name} = {value}" for name, value in entry_points.items()]
    text = "\n".join([f"[{ENTRY_POINT_GROUP}]", *lines])
    metadata.joinpath("entry_points.txt").write_text(text)


def install(site: Path) -> list[str]:
    """Write the metadata into a folder; returns what has to be on Python's path."""
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text())["project"]
    write_metadata(site, project["entry-points"][ENTRY_POINT_GROUP])
    return [str(site), str(FOLDER)]


@contextmanager
def installed(site: Path) -> Iterator[None]:
    """It is installed in this process, for a while."""
    with pytest.MonkeyPatch.context() as patch:
        for place in install(site):
            patch.syspath_prepend(place)
        yield
    sys.modules.pop(MODULE, None)
    surrogate.cache_clear()


@functools.cache
def surrogate():
    """With random weights."""
    from softfin_gru import GruNet, GruSurrogate

    return GruSurrogate(GruNet(4, jax.random.key(0)), small.scaling(), PAPER_LIMITS)
