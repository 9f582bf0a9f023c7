"""Every shape and type in softfin's annotations is checked at run time in the tests."""

import os
from collections.abc import Iterator
from pathlib import Path

# Most of the tests' time is compilation, and many compile the same programs; JAX reads these when it is imported.
# A folder for each worker: JAX writes in place, and half a program that another worker reads ends it.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(__file__).parents[1] / ".pytest_cache" / "xla" / os.environ.get("PYTEST_XDIST_WORKER", "alone")),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("softfin", "beartype.beartype")

PUBLISHED = Path(os.environ.get("SOFTFIN_PUBLISHED", Path(__file__).parents[2] / "shared" / "published"))


MAPPINGS = 30_000
"""Stretches of memory after which compiled programs are dropped: Linux gives a process 65,530, and ends it beyond."""


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """What a module has compiled is kept for the next ones as long as there is room."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MAPPINGS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def published() -> Path:
    """The folder of the authors' published nets, which are not part of softfin."""
    if not (PUBLISHED / "cnn_pos_net.keras").is_file():
        pytest.skip(f"the authors' published nets are not at {PUBLISHED}; set SOFTFIN_PUBLISHED to their folder")
    return PUBLISHED
