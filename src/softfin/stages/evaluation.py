"""Stages that evaluate a controller on a fin (paper Sec. IV-B)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import (
    CONTROLLER,
    DIR,
    FILE,
    FORCE,
    HIDDEN,
    PLANT,
    Config,
    Force,
    PathLike,
    PlantLike,
)
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.core.seeds import check_seed
from softfin.storage import artifact as artifacts
from softfin.storage.paths import check_reference_file
from softfin.storage.registry import check_plant, is_live

if TYPE_CHECKING:
    from softfin.evaluation.evaluate import EvaluateConfig
    from softfin.evaluation.results import EvaluationSummary


def evaluate(
    *controllers: Annotated[PathLike, CONTROLLER],
    plant: Annotated[PlantLike, PLANT] = "tank",
    out: Annotated[PathLike | None, DIR] = None,
    reference: Annotated[tuple[Force, ...], FORCE] = (),
    reference_file: Annotated[PathLike | None, FILE] = None,
    moving: bool = False,
    seconds: int | None = None,
    repeats: int | None = None,
    seed: int | None = None,
    strict: bool = False,
    feedback: bool = False,
    randomize: float | None = None,
    random: int | None = None,
    config: Config = None,
    arm: bool = False,
    yes: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Evaluate a controller on a fin over reference forces (paper Sec. IV-B, Table II).

    Args:
        controllers: Controller folder; several with different seeds are evaluated together.
        plant: tank, a YAML file, a surrogate folder, package.module:plant, rig[:FILE] or
            ros2[:FILE].
        out: Output folder for evaluation.json and the figures (default: only print the scores).
        reference: Reference force [N], such as --reference=1,-0.5; may be repeated (default: the
            paper's six).
        reference_file: Also evaluate a recorded reference (.csv, .parquet): time_s, force_x_n,
            force_y_n.
        moving: Also evaluate four steps of the reference within the range of the controller.
        seconds: Length of each experiment [s] (default: 30).
        repeats: Repetitions of each experiment (default: 5).
        seed: Seed for the plant noise (default: 0).
        strict: Reject unreachable references instead of tracking the nearest reachable one.
        feedback: Add feedback from force and torque, which corrects for changes of the fin.
        randomize: Perturb the parameters of the tank in each repetition, by up to this fraction.
        random: Also evaluate this many random references within the reachable part of the training
            range.
        config: `EvaluateConfig`; its fields are options too.
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        The contents of evaluation.json.

    Example:
        >>> softfin.evaluate("gaits", plant="tank", out="evaluation", feedback=True)
    """
    check_seed(seed)
    if reference_file is not None:
        check_reference_file(Path(reference_file))
    if repeats is not None and repeats < 1:
        raise ConfigurationError(f"--repeats {repeats}: must be at least 1")
    if not controllers and config is not None:
        from softfin.evaluation.evaluate import EvaluateConfig

        # The controller may have been parsed as the value of a misspelled option.
        configure(EvaluateConfig(), config)
    paths = list(map(Path, controllers))
    out = None if out is None else Path(out)
    is_real = isinstance(plant, str) and is_live(plant)
    _check_evaluation(paths, plant, out, is_real, arm, randomize, overwrite)
    from softfin.evaluation.evaluate import EvaluateConfig
    from softfin.stages.tables import evaluation_tables
    from softfin.task.signals import read_reference_file

    recorded = None
    if reference_file is not None:
        recorded = read_reference_file(Path(reference_file)).model_dump()
    settings = configure(
        EvaluateConfig(),
        config,
        references=reference or None,
        recorded=recorded,
        moving=moving or None,
        seconds=seconds,
        seeds=repeats,
        seed=seed,
        strict=strict or None,
        random=random,
    )
    if feedback and settings.feedback is None:
        settings = settings.merged({"feedback": {}}, "--feedback")
    if is_real and out is not None:
        from softfin.rig.arming import Arming, KeyboardStop, say
        from softfin.stages.live import evaluate_live
        from softfin.stages.machines import find_robot

        keys = KeyboardStop(Arming(arm, yes))
        summary = evaluate_live(
            paths[0],
            find_robot(str(plant)),
            out,
            settings,
            keys.confirm,
            stop=keys.stop,
            warn=say,
            overwrite=overwrite,
            progress=progress,
        )
    else:
        summary = _evaluate_simulated(paths, plant, out, settings, randomize, overwrite, progress)
    return Result(summary, evaluation_tables(summary))


def _evaluate_simulated(
    controllers: Sequence[Path],
    plant: PlantLike,
    out: Path | None,
    config: "EvaluateConfig",
    randomize: float | None,
    overwrite: bool,
    progress: Progress,
) -> "EvaluationSummary":
    from softfin.evaluation.evaluate import evaluate_controllers
    from softfin.storage.registry import find_plant
    from softfin.tank import DomainRandomization, RandomizedTank, Tank

    target = find_plant(plant)
    widths = None if randomize is None else DomainRandomization.of(randomize)
    if widths is not None:
        if not isinstance(target, Tank):
            raise ConfigurationError(
                f"--randomize {randomize}: requires the virtual tank as plant, got {plant!r}"
            )
        # At 0, use the tank itself, because RandomizedTank would also change the sensor noise.
        target = target if widths.is_none else RandomizedTank(target, widths)
    metadata = {
        "plant": str(plant),
        "randomization": None if widths is None else widths.model_dump(mode="json"),
    }
    return evaluate_controllers(
        controllers, target, config, out, metadata, overwrite=overwrite, progress=progress
    )


def _check_evaluation(
    controllers: Sequence[Path],
    plant: PlantLike,
    out: Path | None,
    is_real: bool,
    arm: bool,
    randomize: float | None,
    overwrite: bool,
) -> None:
    """Raise a SoftfinError for unusable arguments, before anything is computed or imported."""
    if arm and not is_real:
        raise ConfigurationError(f"--arm: {plant} is simulated; omit --arm, or use --plant rig")
    if is_real and randomize is not None:
        raise ConfigurationError(
            f"--randomize {randomize:g}: requires the virtual tank as plant, got {plant!r}; omit "
            "--randomize"
        )
    if is_real and out is None:
        raise ConfigurationError(f"{plant}: moves in real time; set --out to keep the recording")
    if not controllers:
        raise ConfigurationError(
            "CONTROLLER: missing; usage: softfin evaluate [OPTIONS] CONTROLLER..."
        )
    if is_real and len(controllers) > 1:
        raise ConfigurationError(f"{plant}: moves in real time; evaluate one controller at a time")
    for path in controllers:
        artifacts.find_description(path, "controller")
    if out is not None:
        artifacts.check_vacant(out, overwrite, kind="evaluation")
    if not is_real:
        check_plant(plant)
