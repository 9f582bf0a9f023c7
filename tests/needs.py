"""What some tests need beside the Python packages of `make setup`: they skip without it, or fail
where it is required.

SOFTFIN_REQUIRE lists what must be there, as in SOFTFIN_REQUIRE="node chromium". `.ci/run` sets it,
so that a test that cannot run there is noticed.
"""

import importlib
import os
from typing import Any, NoReturn

import pytest

NAMES = ("chromium", "cyclonedds", "measured", "node", "published", "ray")


def required() -> frozenset[str]:
    """Return what SOFTFIN_REQUIRE lists."""
    listed = frozenset(os.environ.get("SOFTFIN_REQUIRE", "").split())
    if unknown := sorted(listed.difference(NAMES)):
        raise pytest.UsageError(
            f"SOFTFIN_REQUIRE: {', '.join(unknown)} unknown; use {', '.join(NAMES)}"
        )
    return listed


def give_up(name: str, reason: str) -> NoReturn:
    """Skip the test or module that needs what is missing; fail where that is required."""
    if name in required():
        pytest.fail(f"{reason}; SOFTFIN_REQUIRE lists {name}", pytrace=False)
    pytest.skip(reason, allow_module_level=True)


def module(name: str, reason: str) -> Any:
    """Import an optional module."""
    try:
        return importlib.import_module(name)
    except ImportError:
        give_up(name, reason)
