"""Show a plant in motion as a film or a page."""

from pathlib import Path
from typing import Any

from softfin.control.references import resolve_reference
from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import Limits
from softfin.evaluation.view.files import ticks_of
from softfin.evaluation.view.view import ViewConfig, draw, footage_of, title_of
from softfin.stages.evaluate import check_limits
from softfin.storage.paths import check_view
from softfin.storage.registry import find_plant


def view(
    plant: str | Plant,
    out: Path,
    config: ViewConfig | None = None,
    *,
    controller: Path | None = None,
    reference: tuple[float, float] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Show a plant in motion as .gif, .mp4, .html or .png, in a simple gait or under a controller."""
    config = config or ViewConfig()
    check_view(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    holding = None if controller is None else load_controller(controller)
    if (holding is None) != (reference is None):
        raise ConfigurationError("a controller and a reference belong together; give both or none")
    if holding is not None and config.random:
        raise ConfigurationError("random commands and a controller at once; give one of them")
    warnings: list[str] = []
    if controller is not None and holding is not None and reference is not None:
        pairs = [resolve_reference(holding, asked, strict=False) for asked in (reference, *config.next_references)]
        reference, *following = (force for force, _ in pairs)
        config = config.merged({"next_references": following}, "view")
        warnings = [warning for _, warning in pairs if warning is not None]
        check_limits(holding.limits, Limits(*moving.limits), controller, plant)
    named = plant if isinstance(plant, str) else type(plant).__name__
    title = title_of(named, config, reference)

    def report(done: float) -> None:
        if progress is not None:
            progress("view", done, "")

    report(0.0)
    footage = footage_of(moving, config, holding, reference)
    draw(footage, out, title, config, report)
    ticks = len(footage.shape)
    films = out.suffix in (".gif", ".mp4")
    return {
        "view": str(out),
        "title": title,
        "seconds": config.seconds,
        "frames": len(ticks_of(ticks, config.frames_per_second)) if films else None,
        "mean_force_n": [round(float(force), 4) for force in footage.reading.force.mean(axis=0)],
        "shape_known": footage.shape_known,
        "warning": "; ".join(warnings) or None,
    }
