"""Finding a plant by what a user calls it: ``tank``, a tank's YAML, a surrogate's folder, ``package.module:plant``."""

import hashlib
import importlib
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from softfin import artifacts
from softfin.configuration import read_yaml
from softfin.errors import PlantError
from softfin.live import is_live
from softfin.plant import Plant
from softfin.quantities import Limits

HELP = "tank, the YAML file of a tank, the folder of a surrogate, or package.module:plant (one's own simulator)"


def find_plant(name: str) -> Plant:
    """The plant that `name` stands for; raises PlantError with what there is."""
    plant = _found(name)
    try:
        problem = Limits(*map(float, plant.limits)).problem()
    except (TypeError, ValueError) as error:
        raise PlantError(f"plant {name}: its limits are no softfin.Limits of four numbers ({error})") from None
    if problem:
        raise PlantError(f"plant {name}: {problem}")
    return plant


def _found(name: str) -> Plant:
    path = Path(name)
    if is_live(name):
        raise PlantError(f"plant {name}: moves in real time and cannot be simulated; collect, evaluate and run take it")
    if name == "tank":
        from softfin.tank import Tank

        return Tank()
    if path.suffix in (".yaml", ".yml") and path.is_file():
        from softfin.tank import Tank, TankConfig

        return Tank(TankConfig.build(read_yaml(path), str(path)))
    if artifacts.is_kind(path, "surrogate"):
        from softfin.surrogate import load_surrogate

        return load_surrogate(path)
    module, colon, attribute = name.partition(":")
    if colon and not path.exists():
        return _imported(name, module, attribute)
    what = (
        "holds no surrogate.json" if path.is_dir() else "is a file of no such kind" if path.exists() else "is no folder"
    )
    raise PlantError(f"plant {name}: unknown ({what}); give {HELP}")


def is_surrogate(name: str) -> bool:
    """Whether `name` stands for a surrogate's folder."""
    return name != "tank" and artifacts.is_kind(Path(name), "surrogate")


def identity(plant: Plant) -> str:
    """What kind of plant, and a hash of all its arrays and settings: equal for equal plants in every process."""
    arrays, rest = eqx.partition(plant, eqx.is_array)
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(arrays):
        digest.update(np.asarray(leaf).tobytes())
    # Of a plant that JAX knows nothing of, the whole object is one leaf, and its text may hold an address.
    digest.update(str(jax.tree.structure(rest)).encode())
    return f"{type(plant).__module__}.{type(plant).__qualname__} {digest.hexdigest()[:16]}"


def _imported(name: str, module: str, attribute: str) -> Plant:
    # As `python -m` does: one's own simulator mostly lies in the folder where one works.
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        imported = importlib.import_module(module)
        if not hasattr(imported, attribute):
            raise PlantError(f"plant {name}: module {module} has no {attribute!r}; give {HELP}")
        plant: Any = getattr(imported, attribute)
        if isinstance(plant, type) or (callable(plant) and not isinstance(plant, Plant)):
            plant = plant()
    except PlantError:
        raise
    except Exception as error:
        # It is the user's code that runs here, and it may fail in any way.
        reason = " ".join(str(error).split())
        raise PlantError(f"plant {name}: {type(error).__name__}: {reason}; give {HELP}") from error
    finally:
        sys.path.remove(here)
    if not isinstance(plant, Plant):
        raise PlantError(f"plant {name}: a {type(plant).__name__} is no plant: it needs limits, init and advance; "
                         "softfin.testing.check_plant says what is missing")  # fmt: skip
    return plant
