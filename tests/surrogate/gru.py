"""The example's architecture, named as a user's would be: by its module, in the current folder."""

import functools
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import pytest

from softfin.core.quantities import PAPER_LIMITS
from softfin.storage.registry import import_object
from tests.documents import ROOT
from tests.surrogate import small

FOLDER = ROOT / "examples/gru"
MODULE = "softfin_gru"
NAME = f"{MODULE}:ARCHITECTURE"


@contextmanager
def in_its_folder() -> Iterator[None]:
    """The current folder is the example's for a while."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(FOLDER)
        yield
    sys.modules.pop(MODULE, None)
    surrogate.cache_clear()


@functools.cache
def surrogate():
    """With random weights."""
    net = import_object(f"{MODULE}:GruNet")(4, jax.random.key(0))
    return import_object(f"{MODULE}:GruSurrogate")(net, small.scaling(), PAPER_LIMITS)
