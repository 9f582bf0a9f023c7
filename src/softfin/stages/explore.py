"""The stage that writes a page for trying controllers: plants and controllers in, one HTML file
out."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.explorer.contents import controller_data, outline, plant_data
from softfin.explorer.page import write_explorer_page
from softfin.stages.evaluation import check_limits
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.surrogate import StreamingSurrogate
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
    # A repeated name is lost in the dictionary, so the lengths differ.
    for given, kept in ((plants, moving), (controllers, holding)):
        if len(kept) < len(given) or not given:
            raise ConfigurationError(
                f"{', '.join(map(str, given)) or 'nothing'}: must be one or more, no duplicates"
            )
    data_of_plants = {name: plant_data(name, plant) for name, plant in moving.items()}
    for path, controller in holding.items():
        for name, plant in moving.items():
            check_limits(controller.limits, plant.limits, Path(path), name)
    # A surrogate does not contain its fin's size; draw it like the tank's fin.
    tank = next((plant for plant in moving.values() if isinstance(plant, Tank)), None) or Tank()
    kinds = _labels({path: controller.kind for path, controller in holding.items()})
    names = _labels({name: Path(name).resolve().name for name in moving})
    write_explorer_page(
        out,
        TITLE,
        [
            {"name": kinds[path], **controller_data(controller)}
            for path, controller in holding.items()
        ],
        [
            {
                "name": names[name],
                "outline": outline(plant if isinstance(plant, Tank) else tank),
                **data_of_plants[name],
            }
            for name, plant in moving.items()
        ],
    )
    return {
        "page": str(out),
        "controllers": list(kinds.values()),
        "plants": list(names.values()),
        "bytes": out.stat().st_size,
    }


def is_shown(plant: Plant) -> bool:
    """Whether the page can simulate this plant."""
    return isinstance(plant, Tank | StreamingSurrogate)


def _labels(short: dict[str, str]) -> dict[str, str]:
    """Return a unique label for each item: its short name, with the user's name appended to
    duplicates."""
    counts = Counter(short.values())
    return {
        given: name if counts[name] == 1 else f"{name} ({given})" for given, name in short.items()
    }
