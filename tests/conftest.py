"""Every shape of an array in softfin's annotations is checked at run time in the tests."""

import contextlib
import gc
import os
import signal
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

# Most of the tests' time is compilation. They run so little of a program that optimising it takes
# longer, and many compile the same ones, so that all workers, and the next run, share a cache.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
if version("jaxlib") == "0.10.2":
    # The older of its code generators is twice as quick, and so small programs are best compiled
    # in one piece; XLA ends a process over a flag that it does not know.
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    os.environ.setdefault("XLA_FLAGS", flags)
PROGRAMS = Path.home() / ".cache" / "softfin-tests"
os.environ.setdefault("SOFTFIN_CACHE", str(PROGRAMS))

from softfin.core.program_cache import use_program_cache  # noqa: E402

# JAX reads the settings when it is imported, which the type checks of the next softfin module do.
use_program_cache()

import hypothesis  # noqa: E402
import jax  # noqa: E402
import jaxtyping  # noqa: E402
import pytest  # noqa: E402

from tests import needs  # noqa: E402
from tests.budget import (  # noqa: E402, F401  # pytest finds hooks here
    pytest_collection_modifyitems,
    pytest_runtest_logreport,
    pytest_runtest_makereport,
    pytest_sessionstart,
    pytest_terminal_summary,
)

SOFTFIN = Path(__file__).parents[1] / "src" / "softfin"
CHECKED = [
    f"softfin.{'.'.join(path.relative_to(SOFTFIN).with_suffix('').parts)}"
    for path in SOFTFIN.rglob("*.py")
    if path.relative_to(SOFTFIN).parts[0] not in ("rig", "emulation", "stages")
    and path != SOFTFIN / "testing" / "devices.py"
]
"""Modules whose annotations are checked at each call. The rig and its emulation have hardly any
arrays, and the checks made its simulated loops five times as slow. The stages state what can be
typed on the command line; their plants and configurations may also be objects."""

# A shell's background jobs ignore Ctrl-C, and so would the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
# As in the command line: tracing makes millions of small objects.
gc.set_threshold(50_000, 20, 10)
jaxtyping.install_import_hook(CHECKED, "beartype.beartype")
# Hypothesis fails examples that take longer than 200 ms, or whose data are drawn slowly: no matter
# of the code but of the computer and of what else runs on it.
hypothesis.settings.register_profile(
    "softfin", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("softfin")

PUBLISHED = Path(
    os.environ.get("SOFTFIN_PUBLISHED", Path(__file__).parents[2] / "shared" / "published")
)

MEASURED = Path(
    os.environ.get("SOFTFIN_MEASURED", Path(__file__).parents[2] / "shared" / "measured")
)


PROGRAMS_BYTES = 2**30
"""Size of the cache of programs above which the oldest are deleted, before any test."""

MAPPINGS = 30_000
"""Stretches of memory after which compiled programs are dropped: Linux gives a process 65,530, and
ends it beyond."""

MEMORY_BYTES = 1_500_000_000
"""Of a worker, after which they are dropped, too."""


def pytest_configure(config: pytest.Config) -> None:
    """Keep the cache small; another run may do so at the same time."""
    size = 0
    with contextlib.suppress(OSError):
        newest_first = sorted(PROGRAMS.iterdir(), key=lambda file: -file.stat().st_mtime)
        for file in newest_first:
            size += file.stat().st_size
            if size > PROGRAMS_BYTES:
                file.unlink()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes files of expected text anew."""
    parser.addoption("--rewrite", action="store_true", help="write files of expected text anew")


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """What a module has compiled is kept for the next ones as long as there is room."""
    yield
    own = Path("/proc/self")
    if not (own / "statm").exists():
        return
    resident = int((own / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if resident > MEMORY_BYTES or len((own / "maps").read_bytes().splitlines()) > MAPPINGS:
        jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def quick_activation() -> Iterator[None]:
    """A session at the rig collects all garbage before its fin moves, which takes 0.2 s here, and its
    thread, which goes on to the next test, gets real-time priority."""
    without = SimpleNamespace(collect=lambda: 0, freeze=gc.freeze, unfreeze=gc.unfreeze)
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr("softfin.rig.session.gc", without)
        for name in ("set_priority", "set_loop_priority"):
            patches.setattr(f"softfin.rig.session.{name}", lambda *words: False)
        yield


@pytest.fixture(scope="session")
def published() -> Path:
    """The folder of the authors' published networks, which are not part of softfin."""
    if not (PUBLISHED / "cnn_pos_net.keras").is_file():
        reason = (
            f"the authors' published networks are not at {PUBLISHED}; set SOFTFIN_PUBLISHED "
            "to their folder"
        )
        needs.give_up("published", reason)
    return PUBLISHED


@pytest.fixture(scope="session")
def measured() -> Path:
    """The folder of measurements by others, which are not part of softfin."""
    if not (MEASURED / "beam").is_dir():
        reason = f"no measurements at {MEASURED}; set SOFTFIN_MEASURED to the folder with beam/"
        needs.give_up("measured", reason)
    return MEASURED
