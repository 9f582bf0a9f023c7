"""Makes ``softfin/ForceTracking-v0`` known to Gymnasium; the environment itself is imported when it is made.

Gymnasium 1 loads no plugins by entry points. It imports a module that is named in front of the ID, as in
``softfin:softfin/ForceTracking-v0``; else the module has to be imported before, and here the order does not matter.
"""

import importlib.util
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

ID = "softfin/ForceTracking-v0"


def register() -> None:
    """Register the environment; imports Gymnasium, does nothing the second time."""
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point="softfin.gym:ForceTrackingEnv")


def register_with_gymnasium() -> None:
    """Register at once where Gymnasium is imported already, else as soon as it is; importing it here takes a second."""
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """The spec of Gymnasium whose loader registers, once; None for all other modules."""
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                register()

            # On this one loader only: it belongs to this import.
            setattr(spec.loader, "exec_module", load_and_register)  # noqa: B010
        return spec
