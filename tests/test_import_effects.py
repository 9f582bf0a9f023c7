"""Importing softfin computes nothing, and leaves JAX and the import system as they are."""

import subprocess
import sys

from tests.patience import HANG_S

IMPORT_ALL = """
import contextlib
import importlib
import pkgutil
import sys
import types

import jax

# What these do is their own affair.
others = ("equinox", "optax", "cma", "gymnasium", "tensorboardX", "matplotlib.pyplot", "ray", "ndonnx", "onnxruntime")
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
# A first computation would start JAX before the user can say on which device, and takes a second.
from jax._src import xla_bridge

assert not xla_bridge._backends
"""


def run(script: str) -> None:
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 0, done.stderr


def test_importing_any_module_leaves_jax_and_the_import_system_as_they_are() -> None:
    run(IMPORT_ALL)
