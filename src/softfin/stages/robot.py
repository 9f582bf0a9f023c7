"""Stages for robots with several fins: check, evaluation, and a page that shows a trial."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.robot.baselines import build_drivers
from softfin.robot.check import check_robot
from softfin.robot.description import RobotConfig, load_robot
from softfin.robot.evaluate import RobotEvaluateConfig, evaluate_robot, find_all_gaits, trial
from softfin.robot.figures import draw_trials
from softfin.robot.simulation import RobotSimulation
from softfin.robot.view.page import write_robot_page
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.tank import Tank

TITLES = {
    "hold": "holds its place",
    "lemniscate": "follows a lemniscate",
    "lissajous": "follows a Lissajous curve",
}


def check_robot_file(robot: str) -> JsonObject:
    """Return rank, singular values, reach and stability of a robot: a built-in name or a YAML
    file."""
    config = load_robot(robot)
    return check_robot(config, find_all_gaits(build_tanks(config)))


def evaluate(
    robot: str,
    out: Path,
    config: RobotEvaluateConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Evaluate a robot in simulation; writes ``robot.json``, figures and one page per task to
    `out`."""
    artifacts.check_vacant(out, overwrite)
    config = config or RobotEvaluateConfig()
    body = load_robot(robot)
    found = evaluate_robot(
        body, build_tanks(body), config, lambda done, note: progress("robot", done, note)
    )
    result = {
        **artifacts.head("robot"),
        **found.figures,
        "configuration": config.model_dump(mode="json"),
    }

    def write(folder: Path) -> None:
        artifacts.write_description(folder, "robot", result)
        for task, record in found.records.items():
            write_robot_page(folder / f"{task}.html", body, record, _title(body, task, config.dead))
        draw_trials(folder, found.records)

    artifacts.write_folder(out, write, overwrite)
    return result


VIEWED = RobotEvaluateConfig(tasks=("hold",), hold_s=60, settled_s=15, path_s=100)
"""Trial shown by default."""


def view(
    robot: str,
    out: Path,
    config: RobotEvaluateConfig = VIEWED,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Show one trial of the first task on a page in 3D; returns its errors."""
    task = config.tasks[0]
    if out.suffix != ".html":
        raise ConfigurationError(f"{out}: must end in .html")
    if task not in TITLES:
        raise ConfigurationError(
            f"{task}: no page for this task; available tasks are {', '.join(TITLES)}"
        )
    artifacts.check_file(out, overwrite)
    body = load_robot(robot)
    tanks = build_tanks(body)
    progress("robot", 0.0, "gaits of the fins")
    gaits = find_all_gaits(tanks)
    progress("robot", 0.3, task)
    driver = build_drivers(body, gaits)["whole"]
    record, row = trial(RobotSimulation(body, tanks), driver, task, config, config.seed)
    write_robot_page(out, body, record, _title(body, task, config.dead))
    progress("robot", 1.0, "")
    return row


def _title(robot: RobotConfig, task: str, dead: bool) -> str:
    return f"{robot.name} {TITLES[task]}" + (" when a fin dies" if dead else "")


def build_tanks(robot: RobotConfig) -> list[Tank]:
    """Build the tank of each fin; fins with the same plant share a tank. Raises ConfigurationError
    if a plant is not a tank."""
    built: dict[str, Tank] = {}
    for name, fin in robot.fins.items():
        if fin.range_rad is not None:
            raise ConfigurationError(
                f"robot {robot.name}: {name} has a limited range, but simulated fins turn all the "
                "way round; omit range_rad"
            )
        if fin.plant not in built:
            plant = find_plant(fin.plant)
            if not isinstance(plant, Tank):
                raise ConfigurationError(
                    f"robot {robot.name}: {name} is {fin.plant}, but only a tank models a moving "
                    "mount; use tank, or the YAML file of a tank"
                )
            built[fin.plant] = plant
        first = next(iter(built.values()))
        if _shapes(built[fin.plant]) != _shapes(first):
            raise ConfigurationError(
                f"robot {robot.name}: {name} is {fin.plant}, whose structure differs from that of "
                "the previous fins; use tanks with the same number of plates"
            )
    return [built[fin.plant] for fin in robot.fins.values()]


def _shapes(tank: Tank) -> tuple[Any, ...]:
    """Return the structure that tanks must share to run in one compiled program."""
    arrays, rest = eqx.partition(tank, eqx.is_array)
    return jax.tree.structure(rest), [leaf.shape for leaf in jax.tree.leaves(arrays)]
