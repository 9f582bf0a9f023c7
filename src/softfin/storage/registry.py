"""Finding a plant by what a user calls it: ``tank``, a tank's YAML, a surrogate's folder, ``package.module:plant``."""

from pathlib import Path
from typing import Any

from softfin.core.configuration import read_yaml
from softfin.core.errors import PlantError
from softfin.core.plant import Plant
from softfin.core.quantities import Limits
from softfin.storage import artifact as artifacts
from softfin.storage.live import TANK, is_live
from softfin.storage.plant_names import import_object, resolve_plant, running_user_code


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
    return name != TANK and not is_live(name) and artifacts.is_kind(Path(name), "surrogate")


def _built(name: str, plant: Any) -> Plant:
    """A plant from what the user's module holds under that name: itself, or what its class or function makes."""
    if isinstance(plant, type) or (callable(plant) and not isinstance(plant, Plant)):
        with running_user_code(name):
            plant = plant()
    if not isinstance(plant, Plant):
        raise PlantError(f"plant {name}: a {type(plant).__name__} is no plant: it needs limits, init and advance; "
                         "softfin.testing.check_plant says what is missing")  # fmt: skip
    return plant
