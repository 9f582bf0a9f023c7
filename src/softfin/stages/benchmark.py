"""Stage that runs the benchmark on a controller or a policy."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError, one_line
from softfin.core.option_types import (
    CONTROLLER,
    DIR,
    HIDDEN,
    PLANT,
    Config,
    Entry,
    PathLike,
    PlantLike,
)
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.storage import artifact as artifacts
from softfin.storage.registry import build_object, check_plant, find_plant, plant_name

if TYPE_CHECKING:
    from softfin.control.controller import Controller
    from softfin.control.family import Family
    from softfin.core.quantities import Limits


def benchmark(
    controller: Annotated[Entry, CONTROLLER],
    *,
    plant: Annotated[PlantLike, PLANT] = "tank",
    out: Annotated[PathLike | None, DIR] = None,
    feedback: bool = False,
    config: Config = None,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Run the benchmark protocol on a controller: references, steps, turns, perturbed tanks, a fin
    that changes, and the frequency response. Errors are those of the true force.

    Args:
        controller: Controller folder, or package.module:name of a Controller or of a policy with
            predict.
        plant: tank, or a tank YAML file.
        out: Output folder for benchmark.json and the figure (default: only print the scores).
        feedback: Add feedback from force and torque, which corrects for changes of the fin.
        config: `BenchmarkProtocol`; its fields are options too. Compare only unchanged protocols.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        The contents of benchmark.json.

    Example:
        >>> softfin.benchmark("gaits", out="benchmark", feedback=True)
    """
    check_plant(plant)
    if out is not None:
        artifacts.check_vacant(Path(out), overwrite, kind="benchmark")
    if isinstance(controller, str | Path) and not _is_import(controller):
        artifacts.find_description(Path(controller), "controller")
    from softfin.control.controller import controller_clock
    from softfin.control.feedback import FeedbackConfig
    from softfin.evaluation.benchmark import PROTOCOL_VERSION, BenchmarkProtocol, run_benchmark
    from softfin.evaluation.evaluate import check_limits
    from softfin.tank import Tank

    protocol = configure(BenchmarkProtocol(), config)
    tank = find_plant(plant)
    if not isinstance(tank, Tank):
        raise ConfigurationError(
            f"--plant {plant}: must be tank or a tank YAML file, because the benchmark changes the "
            "parameters of a tank; run softfin calibrate to fit a tank to your fin"
        )
    name = str(controller) if isinstance(controller, str | Path) else type(controller).__name__
    entry, family = _load_entry(controller, name, tank.limits)
    if hasattr(entry, "limits"):
        check_limits(entry.limits, tank.limits, Path(name), plant_name(plant))
    used = FeedbackConfig() if feedback else None
    cases = run_benchmark(entry, tank, protocol, used, family, progress)
    summary = {
        **artifacts.head("benchmark"),
        "protocol_version": PROTOCOL_VERSION,
        "is_standard": protocol == BenchmarkProtocol(),
        "configuration": protocol.model_dump(mode="json"),
        "conditions": {
            "controller": name,
            "kind": getattr(entry, "kind", type(entry).__name__),
            "clock": controller_clock(entry).model_dump(mode="json"),
            "plant": plant_name(plant),
            "feedback": feedback,
        },
        "cases": artifacts.plain(cases),
        "provenance": artifacts.provenance(seed=protocol.seed),
    }
    if out is not None:
        # Imported here because importing Matplotlib takes a second and is needed only for drawing.
        from softfin.evaluation.figures import response_figure
        from softfin.storage.figures import save_figure

        def write(folder: Path) -> None:
            artifacts.write_description(folder, "benchmark", summary)
            if "turn" in cases["frequency"]:
                motions = {name: cases["frequency"][name] for name in ("turn", "pulse")}
                save_figure(response_figure(motions), folder / "frequency_response.png")

        artifacts.write_folder(Path(out), write, overwrite)
    from softfin.stages.tables import benchmark_table

    return Result(summary, benchmark_table(summary))


def _is_import(name: str | Path) -> bool:
    return ":" in str(name) and not Path(name).exists()


def _load_entry(
    controller: Entry, name: str, limits: "Limits"
) -> "tuple[Controller, Family | None]":
    """Return the controller to run, and the family of its fin if there is one; a policy acts within
    `limits`."""
    from softfin.control.controller import Controller
    from softfin.control.family import load_family
    from softfin.control.store import load_controller
    from softfin.evaluation.predict import PolicyController, PredictPolicy

    if isinstance(controller, str | Path) and not _is_import(controller):
        loaded = load_controller(controller)
        return loaded, load_family(Path(controller), loaded)
    entry = controller
    if isinstance(controller, str | Path):
        try:
            entry = build_object(name, (Controller, PredictPolicy))
        except Exception as error:
            # The user's code may raise any error.
            raise ConfigurationError(
                f"{name}: {type(error).__name__}: {one_line(error)}; use a controller folder, or "
                "package.module:name"
            ) from error
    if isinstance(entry, PredictPolicy):
        return PolicyController(entry, limits), None
    if not isinstance(entry, Controller):
        raise ConfigurationError(
            f"{name}: a {type(entry).__name__} is neither a controller (init, act, check) nor a "
            "policy (predict); see docs/benchmark.md"
        )
    return entry, None
