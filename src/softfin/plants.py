"""Finding a plant by what a user calls it: ``tank``, a tank's YAML, a surrogate's folder, ``package.module:plant``."""

import hashlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from softfin import artifacts
from softfin.configuration import read_yaml
from softfin.errors import PlantError
from softfin.plant import Plant
from softfin.plant_names import import_object, resolve_plant, running_user_code


def find_plant(name: str) -> Plant:
    """The plant that `name` stands for; raises PlantError with what there is."""
    kind, path = resolve_plant(name), Path(name)
    if kind == "object":
        return _built(name, import_object(name))
    if kind == "surrogate":
        from softfin.surrogate import load_surrogate

        return load_surrogate(path)
    from softfin.tank import Tank, TankConfig

    return Tank() if kind == "tank" else Tank(TankConfig.build(read_yaml(path), str(path)))


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


def _built(name: str, plant: Any) -> Plant:
    """A plant from what the user's module holds under that name: itself, or what its class or function makes."""
    if isinstance(plant, type) or (callable(plant) and not isinstance(plant, Plant)):
        with running_user_code(name):
            plant = plant()
    if not isinstance(plant, Plant):
        raise PlantError(f"plant {name}: a {type(plant).__name__} is no plant: it needs limits, init and advance; "
                         "softfin.testing.check_plant says what is missing")  # fmt: skip
    return plant
