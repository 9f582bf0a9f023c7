"""Stages for controllers: find gaits for the reachable forces of a fin, train policies (paper Sec.
III-C), and export a controller to ONNX."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from softfin.core.choices import PolicyLayout, TrainingRangeName
from softfin.core.configuration import Changes, configure
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.option_types import (
    CONTROLLER,
    DIR,
    FILE,
    HIDDEN,
    PLANT,
    Config,
    PathLike,
    PlantLike,
)
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.core.seeds import check_seed
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.paths import typed_path
from softfin.storage.registry import check_plant, plant_name

if TYPE_CHECKING:
    from softfin.core.action_clock import ActionClock

AUTO = "auto"
"""Option value for a clock that suits the stroke time of the fin."""

CLOCK = Parameter(metavar="HZ[,S]")

MAX_ERROR_SHARE = 0.5
"""Maximum error of a useful controller, divided by the target forces."""


def find_clock(text: str | None, plant: PlantLike) -> "ActionClock | None":
    """Return the clock for the text of ``--clock``; for ``auto``, it depends on the stroke time of
    the plant. Raises ConfigurationError if there is no such clock, or if the stroke time is
    unknown."""
    from softfin.core.action_clock import ActionClock

    if text is None:
        return None
    if text != AUTO:
        return ActionClock.parse(text)
    stroke_s = None
    if isinstance(plant, str | Path) and artifacts.is_kind(Path(plant), "surrogate"):
        stroke_s = artifacts.load_description(Path(plant), "surrogate").get("stroke_s")
    if stroke_s is None:
        raise ConfigurationError(
            f"--clock auto: the stroke time of {plant} is unknown; use a rate in Hz such as 3, or "
            "fit a surrogate to logs of this fin (softfin fit)"
        )
    return ActionClock.for_strokes(stroke_s)


@lock_output
def map_forces(
    plant: Annotated[PlantLike, PLANT],
    *,
    out: Annotated[PathLike, DIR],
    clock: Annotated[str | None, CLOCK] = None,
    power: Annotated[float | None, Parameter(metavar="N/W")] = None,
    config: Config = None,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Find the mean forces that a fin can produce, and the gaits that produce them.

    Args:
        plant: Surrogate folder, or another plant: tank or package.module:plant.
        out: Controller folder to write: the gaits, the forces that they produce, and a figure.
        clock: Clock: actions per second and window [s], e.g. 6,1; auto: from the stroke time of the
            fin (default: paper, which is 3,2).
        power: Weight of the power in the search for gaits, e.g. 0.3 (default: 0, smoothest gaits).
        config: `MapConfig`; its fields are options too, such as --nodes 200.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        Range, area and number of the forces, and the paper's references that are out of reach.

    Example:
        >>> softfin.map_forces("surrogate", out="gaits")
    """
    out = Path(out)
    chosen_clock = find_clock(clock, plant)
    artifacts.check_vacant(out, overwrite, kind="controller")
    check_plant(plant)
    from softfin.control.store import save_gaits
    from softfin.core.plant_identity import identity
    from softfin.core.quantities import Limits
    from softfin.gaits.force_map import MapConfig, find_force_map, force_tolerance, star_warning
    from softfin.gaits.reachable import PAPER_REFERENCES
    from softfin.storage.registry import find_plant
    from softfin.surrogate.channels import learnt_from

    settings = configure(
        MapConfig(),
        config,
        clock=chosen_clock and chosen_clock.model_dump(),
        gaits=None if power is None else {"power": power},
    )
    simulated = find_plant(plant)
    force_map = find_force_map(simulated, settings, partial(progress, "map"))
    reachable = force_map.reachable
    tolerance_n = force_tolerance(reachable)
    keys = {
        **learnt_from(plant),
        "configuration": settings.model_dump(mode="json"),
        "provenance": artifacts.provenance(
            plant=plant_name(plant), plant_identity=identity(simulated)
        ),
    }
    limits = Limits(*map(float, simulated.limits))
    save_gaits(out, force_map, tolerance_n, limits, keys, overwrite)
    errors = force_map.gaits.force_error()
    box = reachable.bounding_box()
    values = {
        "controller": str(out),
        "clock": str(settings.clock),
        "box_n": (box.low, box.high),
        "area_n2": reachable.area(),
        "nodes": errors.size,
        "held": int((errors <= tolerance_n).sum()),
        "tolerance_n": tolerance_n,
        "reach_n": reachable.reach_n,
        "beyond": [list(force) for force in PAPER_REFERENCES if not reachable.contains(force)],
        "warning": star_warning(force_map, tolerance_n),
    }
    return Result(values, f"{_describe_map(values)}\n{next_step(out, plant)}")


def family(
    controller: Annotated[PathLike, CONTROLLER],
    *,
    plant: Annotated[PlantLike, PLANT] = "tank",
    config: Config = None,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Find the family of a fin: how changes in stiffness, drag, servo and other parameters affect
    the mean forces of a controller and the measurements.

    Feedback uses the family to estimate within seconds, from force and torque, how the fin has
    changed. The family is written into the folder of the controller.

    Args:
        controller: Controller folder.
        plant: tank, or a tank YAML file, such as the output of softfin calibrate.
        config: `FamilyConfig`; its fields are options too, such as --fins 100.
        progress: Function that is called with the progress.

    Returns:
        The RMS change in the mean force that the family explains, and the unexplained part [N].

    Example:
        >>> softfin.family("gaits", plant="calibration/tank.yaml")
    """
    path = Path(controller)
    artifacts.find_description(path, "controller")
    check_plant(plant)
    import numpy as np

    from softfin.control.family import FAMILY_KIND, save_family
    from softfin.control.store import load_controller
    from softfin.core.plant_identity import identity
    from softfin.evaluation.find_family import FamilyConfig, find_family
    from softfin.storage.registry import find_plant
    from softfin.tank import Tank

    loaded = load_controller(path)
    settings = configure(FamilyConfig(), config)
    fin = find_plant(plant)
    if not isinstance(fin, Tank):
        raise ConfigurationError(
            f"--plant {plant}: must be tank or a tank YAML file, because softfin can vary only the "
            "parameters of a tank; run softfin calibrate to fit a tank to your logs"
        )
    found = find_family(loaded, fin, settings, progress)
    keys = {
        "configuration": settings.model_dump(mode="json"),
        "provenance": artifacts.provenance(plant=plant_name(plant), plant_identity=identity(fin)),
    }
    save_family(path, loaded, found, keys)
    spanned_n = float(np.sqrt((found.force**2).sum(axis=2).mean()))
    unexplained_n = float(np.sqrt((found.force_noise**2).mean()))
    values = {
        "family": str(path / FAMILY_KIND),
        "fins": settings.fins,
        "coefficients": settings.coefficients,
        "spanned_n": round(spanned_n, 4),
        "unexplained_n": round(unexplained_n, 4),
    }
    text = (
        f"{values['family']}: {settings.fins} fins; their mean forces differ by {spanned_n:.2g} N "
        f"(rms), and {settings.coefficients} coefficients explain all but {unexplained_n:.1g} N\n"
        f"next: softfin evaluate {path} --plant {plant_name(plant)} --feedback"
    )
    return Result(values, text)


def _describe_map(values: JsonObject) -> str:
    from softfin.gaits.reachable import force_decimals

    decimals = force_decimals(values["reach_n"])
    # Adding 0 turns -0.0 into 0.
    (x0, y0), (x1, y1) = (
        tuple(round(x, decimals) + 0.0 for x in corner) for corner in values["box_n"]
    )
    beyond = ", ".join(f"({x:g}, {y:g})" for x, y in values["beyond"]) or "none"
    warning = "" if values["warning"] is None else f"\nwarning: {values['warning']}"
    return (
        f"{values['controller']}: mean forces of x {x0:g} .. {x1:g} N and y {y0:g} .. {y1:g} N, "
        f"area {values['area_n2']:.3g} N2; {values['held']} of the {values['nodes']} forces on the "
        f"grid have a gait that produces them to within {values['tolerance_n']:g} N\n"
        f"clock: {values['clock']}\n"
        f"references of the paper that this fin cannot reach: {beyond}{warning}"
    )


@lock_output
def train(
    surrogate: Annotated[PlantLike, Parameter(metavar="SURROGATE")],
    *,
    out: Annotated[PathLike, DIR],
    controller: PolicyLayout | None = None,
    range: TrainingRangeName | None = None,
    clock: Annotated[str | None, CLOCK] = None,
    steps: int | None = None,
    seed: int = 0,
    config: Config = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Train force controllers inside a surrogate with LSTM-PPO (paper Sec. III-C).

    A survey of gaits first determines the forces that the fin can produce.

    Args:
        surrogate: Surrogate folder, or another plant: tank or package.module:plant.
        out: Controller folder to write.
        controller: single: one policy for all references (default); grid: one policy per cell of a
            grid.
        range: reach: all forces that the fin can produce (default); paper: the range in the paper.
        clock: Clock: actions per second and window [s], e.g. 6,1; auto: from the stroke time of the
            fin (default: paper, which is 3,2).
        steps: Number of training actions per policy (default: 400000, or 66000 per cell of a grid).
        seed: Seed for weights, exploration and references.
        config: `TrainConfig`; its fields are options too, such as --ppo.num-envs 64.
        resume: Continue from the last checkpoint of an unfinished run.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        Folder, and errors of the policies at the evaluation references.

    Example:
        >>> softfin.train("surrogate", out="single", steps=100_000)
    """
    out = Path(out)
    check_seed(seed)
    chosen_clock = find_clock(clock, surrogate)
    artifacts.check_vacant(out, overwrite or resume, kind="controller")
    check_plant(surrogate)
    from softfin.core.plant_identity import identity
    from softfin.gaits.simulate import SurveyConfig, survey
    from softfin.gaits.usable import check_usable
    from softfin.learning.configuration import TRAIN_PRESETS, for_clock
    from softfin.learning.controllers import save_policies
    from softfin.learning.train import train_policies
    from softfin.storage.registry import find_plant
    from softfin.storage.run_directory import RunDirectory
    from softfin.surrogate.channels import learnt_from

    # The layout may be set in the file.
    layout = configure(TRAIN_PRESETS["single"], config, controller=controller).controller
    preset = TRAIN_PRESETS[layout]
    if chosen_clock is not None:
        preset = for_clock(preset, chosen_clock)
    settings = configure(preset, config, controller=controller, range=range, steps=steps)
    if chosen_clock is not None and settings.task.clock != chosen_clock:
        # The option overrides the file. Numbers of actions from the file are scaled, but typed
        # numbers are not.
        settings = for_clock(settings, chosen_clock)
        typed = config._replace(file=None) if isinstance(config, Changes) else None
        settings = configure(settings, typed, steps=steps)
    plant = find_plant(surrogate)
    metadata = {
        "configuration": settings.model_dump(mode="json"),
        "seed": seed,
        "plant": identity(plant),
    }
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        # The corners are not pushed outwards, because this takes most of the time of a survey and
        # needs gradients, which a user's simulator may lack. The area is about 5% smaller as a
        # result.
        without_pushes = SurveyConfig(pushes=0)
        surveyed = survey(plant, without_pushes, partial(progress, "survey"), settings.task.clock)
        check_usable(plant, surveyed.reachable)
        report = partial(progress, "train")
        trained = train_policies(plant, settings, surveyed.reachable, seed, run_directory, report)
        origin = artifacts.provenance(
            plant=plant_name(surrogate), plant_identity=identity(plant), seed=seed
        )
        save_policies(
            out, trained, origin, learnt_from(surrogate), overwrite, run_directory.keep_log
        )
    run_directory.finish()
    scores = artifacts.load_description(out, "controller")["scores"]
    head = f"{out}: evaluated in {plant_name(surrogate)}, without exploration noise"
    return Result(
        {"controller": str(out), "clock": str(settings.task.clock), "scores": scores},
        "\n".join(
            [head, *_score_table(scores), *missed_targets(scores), next_step(out, surrogate)]
        ),
    )


def next_step(controller: Path, plant: PlantLike) -> str:
    """Return the command with which to try a controller next."""
    name = typed_path(plant_name(plant))
    return f"next: softfin evaluate {typed_path(controller)} --plant {name}"


def _score_table(scores: Sequence[JsonObject]) -> list[str]:
    from softfin.gaits.reachable import force_decimals
    from softfin.stages.tables import aligned, format_reference_errors

    decimals = force_decimals(max(abs(force) for row in scores for force in row["reference_n"]))
    rows = [["reference [N]", "error x, y [N]", ""]]
    for row in scores:
        x, y = row["reference_n"]
        rows.append(
            [
                f"({x:5.{decimals}f}, {y:5.{decimals}f})",
                ", ".join(f"{error:.{decimals + 1}f}" for error in row["error_n"]),
                format_reference_errors(row, decimals).strip(),
            ]
        )
    return aligned(rows, (0, 1, 2))


def missed_targets(scores: Sequence[JsonObject]) -> list[str]:
    """Return a warning if the errors are larger than half the target forces."""
    error = sum(math.hypot(*row["error_n"]) for row in scores)
    target = sum(math.hypot(*row["tracked_reference_n"]) for row in scores)
    if error <= MAX_ERROR_SHARE * target or target == 0:
        return []
    return [
        f"warning: the errors are {error / target:.0%} of the target forces, so this controller "
        "does not reach the targets; check training/learning.png in its folder, and train it longer"
    ]


def export(
    controller: Annotated[PathLike, CONTROLLER],
    *,
    onnx: Annotated[PathLike, FILE],
    overwrite: bool = False,
) -> Result:
    """Export one step of a controller to ONNX, with its state as inputs and outputs. Requires
    softfin[onnx].

    Args:
        controller: Controller folder.
        onnx: File to write; its metadata describe the inputs.
        overwrite: Replace an existing file.

    Returns:
        Size, inputs and outputs of the file, and the largest difference from softfin's outputs.

    Example:
        >>> softfin.export("single", onnx="single.onnx")
    """
    from softfin.control.onnx import EPISODE, export_onnx
    from softfin.control.store import load_controller

    exported = export_onnx(load_controller(Path(controller)), Path(onnx), overwrite)
    return Result(
        {"onnx": str(onnx), **exported._asdict()},
        f"{onnx}: {exported.bytes:,} bytes, ONNX opset {exported.opset}; over {EPISODE} actions, "
        "the commands from onnxruntime differ from the softfin commands by at most "
        f"{exported.worst:.1g} (rad, rad/s)\nin:  {', '.join(exported.inputs)}\nout: "
        f"{', '.join(exported.outputs)}",
    )
