"""Runs a function once JAX is imported, without importing JAX itself.

A robot runs controllers without JAX, and most commands do not need its import, which takes about a
second. softfin therefore delays its JAX settings until some module imports JAX.
"""

import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

JAX = "jax"


def when_jax_is_imported(action: Callable[[], None]) -> None:
    """Call `action` now if JAX is already imported, otherwise right after its import."""
    if sys.modules.get(JAX) is not None:
        action()
        return
    _FINDER.actions.append(action)
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)


class _JaxFinder(MetaPathFinder):
    """Import hook that finds JAX with the other finders and makes its loader call the actions after
    the import."""

    def __init__(self) -> None:
        self.actions: list[Callable[[], None]] = []

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return JAX's module spec; None for any other module."""
        if fullname != JAX:
            return None
        # Skip this finder, which would otherwise call itself endlessly.
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(fullname, path, target)
            if spec is not None:
                self._extend(spec.loader)
                return spec
        return None

    def _extend(self, loader: Any) -> None:
        execute = loader.exec_module

        def execute_and_act(module: ModuleType) -> None:
            # If the import fails, the actions wait for the next attempt.
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            while self.actions:
                self.actions.pop(0)()

        loader.exec_module = execute_and_act


_FINDER = _JaxFinder()
