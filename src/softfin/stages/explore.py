"""The stage that writes plants and controllers as an explorer page, a single HTML file."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import CONTROLLER, FILE, PLANT, PathLike
from softfin.core.result import Result
from softfin.storage import artifact as artifacts
from softfin.storage.registry import check_plant

if TYPE_CHECKING:
    from softfin.control.controller import LoadedController

TITLE = "Drag the force, watch the fin"
TITLE_BY_HAND = "Move the fin, watch its force"


def explore(
    *controllers: Annotated[PathLike, CONTROLLER],
    out: Annotated[PathLike, FILE],
    plant: Annotated[tuple[str, ...], PLANT] = ("tank",),
    overwrite: bool = False,
) -> Result:
    """Write an HTML page that shows a fin and its force in a browser: drag the target force and
    watch a controller follow it, or move the fin by hand. The page works offline.

    Args:
        controllers: Controller folders (default: none, to move the fin by hand only).
        out: File to write (.html).
        plant: tank, a tank YAML file, or a streaming surrogate folder; may be repeated.
        overwrite: Replace an existing file.

    Returns:
        Size and parts of the page.

    Raises:
        PlantError: If the page cannot simulate a plant, or a plant cannot follow a controller.

    Example:
        >>> softfin.explore("gaits", "single", out="explore.html", plant=("tank", "surrogate"))
    """
    paths = list(map(Path, controllers))
    out = Path(out)
    if out.suffix != ".html":
        raise ConfigurationError(f"--out {out}: must end in .html")
    artifacts.check_file(out, overwrite)
    if not plant:
        raise ConfigurationError("plant: missing; specify at least one")
    _check_distinct(plant)
    _check_distinct(paths)
    for path in paths:
        artifacts.find_description(path, "controller")
    for name in plant:
        check_plant(name)
    from softfin.control.family import load_family
    from softfin.control.store import load_controller
    from softfin.evaluation.evaluate import check_limits
    from softfin.explorer.contents import controller_data, hand_data, outline, plant_data
    from softfin.explorer.page import write_explorer_page
    from softfin.storage.registry import find_plant
    from softfin.tank import Tank

    moving = {name: find_plant(name) for name in plant}
    holding = {str(path): load_controller(path) for path in paths}
    data_of_plants = {name: plant_data(name, fin) for name, fin in moving.items()}
    for path in paths:
        for name, fin in moving.items():
            check_limits(holding[str(path)].limits, fin.limits, path, name)
    clock = _common_clock(holding)
    kinds = _labels({path: controller.kind for path, controller in holding.items()})
    names = _labels({name: Path(name).resolve().name for name in moving})
    page_controllers = []
    for given, controller in holding.items():
        family = load_family(Path(given), controller)
        page_controllers.append({"name": kinds[given], **controller_data(controller, family)})
    size = page_controllers[0]["size"] if page_controllers else None
    limits = [fin.limits for fin in moving.values()]
    page_controllers.append(hand_data(limits, clock, size))
    # A surrogate does not contain the size of its fin; draw it like the fin of the first tank.
    tanks = [fin for fin in moving.values() if isinstance(fin, Tank)]
    default_tank = tanks[0] if tanks else Tank()
    page_plants = []
    for name, fin in moving.items():
        shape = outline(fin if isinstance(fin, Tank) else default_tank)
        page_plants.append({"name": names[name], "outline": shape, **data_of_plants[name]})
    title = TITLE if holding else TITLE_BY_HAND
    write_explorer_page(out, title, page_controllers, page_plants)
    size_bytes = out.stat().st_size
    held = ", ".join(kinds.values()) or "no controller"
    return Result(
        {
            "page": str(out),
            "controllers": list(kinds.values()),
            "plants": list(names.values()),
            "bytes": size_bytes,
        },
        f"{out}: {held} in {', '.join(names.values())}, {size_bytes / 1e6:.1f} MB; open it in a "
        "browser",
    )


def _common_clock(controllers: "Mapping[str, LoadedController]") -> ActionClock:
    """Return the clock of the controllers, or the paper's clock if there are none; raises
    ConfigurationError if their clocks differ."""
    clocks = {path: controller.clock for path, controller in controllers.items()}
    clock = next(iter(clocks.values()), PAPER_CLOCK)
    for path, other in clocks.items():
        if other != clock:
            raise ConfigurationError(
                f"{path}: its clock ({other}) differs from the clock of {next(iter(clocks))} "
                f"({clock}); write a page for each clock"
            )
    return clock


def _check_distinct(given: Sequence[object]) -> None:
    """Raise ConfigurationError if a name is given twice."""
    names = list(map(str, given))
    if len(set(names)) < len(names):
        raise ConfigurationError(f"{', '.join(names)}: contains duplicates; list each plant once")


def _labels(short: dict[str, str]) -> dict[str, str]:
    """Return a unique label for each item: its short name, followed by the user's name for it if
    the short name is not unique."""
    counts = Counter(short.values())
    return {
        given: name if counts[name] == 1 else f"{name} ({given})" for given, name in short.items()
    }
