"""The stage that writes the explorer page: plants and controllers in, one HTML file out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from softfin.control.controller import LoadedController
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.explorer.contents import controller_data, hand_data, outline, plant_data
from softfin.explorer.page import write_explorer_page
from softfin.stages.evaluation import check_limits
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.surrogate.protocol import ExplorableSurrogate
from softfin.tank import Tank

TITLE = "Drag the force, watch the fin"
TITLE_BY_HAND = "Move the fin, watch its force"


def explore(
    controllers: Sequence[Path],
    out: Path,
    plants: Sequence[str] = ("tank",),
    *,
    overwrite: bool = False,
) -> JsonObject:
    """Write a page that shows the motion and force of fins; returns its size and parts.

    Users drag the target force and a controller follows it, or they move the fin by hand.

    Raises PlantError for a plant that the page cannot simulate, or that cannot follow a
    controller's commands.
    """
    artifacts.check_file(out, overwrite)
    moving = {name: find_plant(name) for name in plants}
    holding = {str(path): load_controller(path) for path in controllers}
    if not plants:
        raise ConfigurationError("plants: none given; name at least one")
    _check_distinct(plants)
    _check_distinct(controllers)
    data_of_plants = {name: plant_data(name, plant) for name, plant in moving.items()}
    for path, controller in holding.items():
        for name, plant in moving.items():
            check_limits(controller.limits, plant.limits, Path(path), name)
    clock = _common_clock(holding)
    kinds = _labels({path: controller.kind for path, controller in holding.items()})
    names = _labels({name: Path(name).resolve().name for name in moving})
    page_controllers = []
    for path, controller in holding.items():
        page_controllers.append({"name": kinds[path], **controller_data(controller)})
    size = page_controllers[0]["size"] if page_controllers else None
    limits = [plant.limits for plant in moving.values()]
    page_controllers.append(hand_data(limits, clock, size))
    # A surrogate does not contain its fin's size; draw it like the fin of the first tank.
    tanks = [plant for plant in moving.values() if isinstance(plant, Tank)]
    default_tank = tanks[0] if tanks else Tank()
    page_plants = []
    for name, plant in moving.items():
        shape = outline(plant if isinstance(plant, Tank) else default_tank)
        page_plants.append({"name": names[name], "outline": shape, **data_of_plants[name]})
    title = TITLE if holding else TITLE_BY_HAND
    write_explorer_page(out, title, page_controllers, page_plants)
    return {
        "page": str(out),
        "controllers": list(kinds.values()),
        "plants": list(names.values()),
        "bytes": out.stat().st_size,
    }


def _common_clock(controllers: Mapping[str, LoadedController]) -> ActionClock:
    """Return the clock of the controllers, or the paper's clock without controllers; raises
    ConfigurationError if controllers have different clocks."""
    clocks = {path: controller.clock for path, controller in controllers.items()}
    clock = next(iter(clocks.values()), PAPER_CLOCK)
    for path, other in clocks.items():
        if other != clock:
            raise ConfigurationError(
                f"{path}: its clock ({other}) differs from that of {next(iter(clocks))} ({clock}); "
                "write a page for each clock"
            )
    return clock


def is_shown(plant: Plant) -> bool:
    """Whether the page can simulate this plant."""
    return isinstance(plant, Tank | ExplorableSurrogate)


def _check_distinct(given: Sequence[object]) -> None:
    """Raise ConfigurationError if a name is given twice."""
    names = list(map(str, given))
    if len(set(names)) < len(names):
        raise ConfigurationError(f"{', '.join(names)}: contains duplicates; name each once")


def _labels(short: dict[str, str]) -> dict[str, str]:
    """Return a unique label for each item: its short name, with the user's name appended to
    duplicates."""
    counts = Counter(short.values())
    return {
        given: name if counts[name] == 1 else f"{name} ({given})" for given, name in short.items()
    }
