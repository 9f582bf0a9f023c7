"""What softfin sets up in JAX does not depend on the order of imports, and importing softfin sets
up nothing."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.control.folders import folder_option
from tests.patience import HANG_S

IMPORT_ALL = """
import contextlib
import importlib
import pkgutil
import sys
import types

import jax

# What these do is their own affair.
others = ("equinox", "optax", "cma", "gymnasium", "tensorboardX", "matplotlib.pyplot", "ray", "spox", "onnxruntime")
for name in others:
    with contextlib.suppress(ImportError):
        importlib.import_module(name)


def private_parts():
    parts = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("jax._src"):
            for attribute, value in vars(module).items():
                if isinstance(value, (types.FunctionType, type)):
                    parts[name, attribute] = id(value)
    return parts


settings, parts, finders = dict(jax.config.values), private_parts(), list(sys.meta_path)
import softfin

names = ["softfin"] + [module.name for module in pkgutil.walk_packages(softfin.__path__, "softfin.")]
names.remove("softfin.cli.__main__")
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        assert not error.name.startswith("softfin"), error
after = private_parts()
assert {key for key in parts if after[key] != parts[key]} == set()
assert dict(jax.config.values) == settings
assert sys.meta_path == finders
assert sum(name in sys.modules for name in names) > 100
"""

ARE_PYTREES = """
import sys
from pathlib import Path
{first}
from softfin.control.controller import LoadedController
from softfin.control.disturbance_observer import DisturbanceObserver
from softfin.control.store import CONTROLLER_STEPS, load_controller

controllers = [load_controller(Path(name)) for name in sys.argv[1:]]
controllers += [DisturbanceObserver(controller) for controller in controllers]
assert ("jax" in sys.modules) == bool({first!r})
import jax
import numpy as np

classes = {{type(controller) for controller in controllers}}
steps = {{type(controller.step) for controller in controllers if isinstance(controller, LoadedController)}}
assert classes == {{LoadedController, DisturbanceObserver}}
assert steps == set(CONTROLLER_STEPS.values())
for controller in controllers:
    leaves = jax.tree.leaves(controller)
    assert leaves and all(isinstance(leaf, (np.ndarray, np.generic, float, int)) for leaf in leaves), leaves
    again = jax.tree.map(lambda leaf: leaf, controller)
    assert type(again) is type(controller)
    assert again.cells == controller.cells
"""

WAIT = """
import importlib.util
import sys
from softfin.core.jax_import import when_jax_is_imported

before = list(sys.meta_path)
calls = []
when_jax_is_imported(lambda: calls.append("first"))
when_jax_is_imported(lambda: calls.append(bool(sys.modules["jax"].numpy)))
assert "jax" not in sys.modules
assert importlib.util.find_spec("jax") is not None and calls == []
import jax
assert calls == ["first", True]
when_jax_is_imported(lambda: calls.append("now"))
assert calls == ["first", True, "now"]
assert sys.meta_path == before
assert type(jax.__loader__).__name__ == "SourceFileLoader"
"""

NO_JAX = """
import sys
from softfin.core.jax_import import when_jax_is_imported

class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name == "jax":
            raise ImportError("jax is not on this computer")

refusing = Refusing()
sys.meta_path.insert(0, refusing)
calls = []
when_jax_is_imported(lambda: calls.append("called"))
try:
    import jax
    raise AssertionError("imported")
except ImportError as error:
    assert str(error) == "jax is not on this computer", error
assert calls == []
sys.meta_path.remove(refusing)
import jax
assert calls == ["called"]
"""


def run(script: str, *words: object) -> None:
    command = [sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 0, done.stderr


def test_importing_any_module_leaves_jax_and_the_import_system_as_they_are() -> None:
    run(IMPORT_ALL)


@pytest.mark.parametrize("first", ["", "import jax"], ids=["controllers first", "JAX first"])
def test_controllers_are_pytrees_whether_jax_is_imported_before_or_after_them(
    first: str, tmp_path: Path
) -> None:
    folders = [folder_option(kind, tmp_path) for kind in ("single", "grid", "gaits")]
    run(ARE_PYTREES.format(first=first), *folders)


def test_what_waits_for_jax_is_done_at_the_end_of_its_import() -> None:
    run(WAIT)


def test_what_waits_for_jax_goes_on_waiting_while_its_import_fails() -> None:
    run(NO_JAX)
