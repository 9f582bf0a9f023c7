"""The stage that writes a page for trying controllers: plants and controllers in, one HTML file
out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from softfin.control.controller import LoadedController
from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.explorer.contents import controller_data, outline, plant_data
from softfin.explorer.page import write_explorer_page
from softfin.stages.evaluation import check_limits
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.surrogate.protocol import ExplorableSurrogate
from softfin.tank import Tank

TITLE = "Drag the force, watch the fin"


def explore(
    controllers: Sequence[Path],
    out: Path,
    plants: Sequence[str] = ("tank",),
    *,
    overwrite: bool = False,
) -> JsonObject:
    """Write a page on which users drag the target force and the controllers follow it; returns its
    size and parts.

    Raises PlantError for a plant that the page cannot simulate, or that cannot follow a
    controller's commands.
    """
    artifacts.check_file(out, overwrite)
    moving = {name: find_plant(name) for name in plants}
    holding = {str(path): load_controller(path) for path in controllers}
    _check_named(plants, len(moving))
    _check_named(controllers, len(holding))
    data_of_plants = {name: plant_data(name, plant) for name, plant in moving.items()}
    for path, controller in holding.items():
        for name, plant in moving.items():
            check_limits(controller.limits, plant.limits, Path(path), name)
    _check_clocks(holding)
    kinds = _labels({path: controller.kind for path, controller in holding.items()})
    names = _labels({name: Path(name).resolve().name for name in moving})
    page_controllers = []
    for path, controller in holding.items():
        page_controllers.append({"name": kinds[path], **controller_data(controller)})
    # A surrogate does not contain its fin's size; draw it like the fin of the first tank.
    tanks = [plant for plant in moving.values() if isinstance(plant, Tank)]
    default_tank = tanks[0] if tanks else Tank()
    page_plants = []
    for name, plant in moving.items():
        shape = outline(plant if isinstance(plant, Tank) else default_tank)
        page_plants.append({"name": names[name], "outline": shape, **data_of_plants[name]})
    write_explorer_page(out, TITLE, page_controllers, page_plants)
    return {
        "page": str(out),
        "controllers": list(kinds.values()),
        "plants": list(names.values()),
        "bytes": out.stat().st_size,
    }


def _check_clocks(controllers: Mapping[str, LoadedController]) -> None:
    """Raise ConfigurationError unless all controllers have the same clock."""
    first, *others = controllers
    for other in others:
        if controllers[other].clock != controllers[first].clock:
            raise ConfigurationError(
                f"{other}: its clock ({controllers[other].clock}) differs from that of {first} "
                f"({controllers[first].clock}); write a page for each clock"
            )


def is_shown(plant: Plant) -> bool:
    """Whether the page can simulate this plant."""
    return isinstance(plant, Tank | ExplorableSurrogate)


def _check_named(given: Sequence[object], num_distinct: int) -> None:
    """Raise ConfigurationError unless there is at least one name and no duplicates."""
    if not given or num_distinct < len(given):
        names = ", ".join(map(str, given)) or "nothing"
        raise ConfigurationError(f"{names}: must be one or more, no duplicates")


def _labels(short: dict[str, str]) -> dict[str, str]:
    """Return a unique label for each item: its short name, with the user's name appended to
    duplicates."""
    counts = Counter(short.values())
    return {
        given: name if counts[name] == 1 else f"{name} ({given})" for given, name in short.items()
    }
