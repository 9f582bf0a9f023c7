"""Stages of robots with several fins: what one can do, how well it holds and follows, and a page that shows it."""

from pathlib import Path
from typing import Any

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.progress import Progress, silent
from softfin.robot.check import check_robot
from softfin.robot.description import RobotConfig, load_robot
from softfin.robot.evaluate import RobotEvaluateConfig, evaluate_robot, gaits_of, trial
from softfin.robot.figures import draw_trials
from softfin.robot.simulation import RobotSimulation
from softfin.robot.view.page import write_page
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant

TITLES = {"hold": "holds its place", "lemniscate": "follows a lemniscate", "lissajous": "follows a Lissajous curve"}


def check(robot: str) -> dict[str, Any]:
    """Return rank, singular values and reach of a robot: the name of one that is built in, or a YAML file."""
    config = load_robot(robot)
    return check_robot(config, gaits_of(plants_of(config)))


def evaluate(
    robot: str, out: Path, config: RobotEvaluateConfig | None = None, *, overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Evaluate a robot in simulation; writes ``robot.json``, figures and a page for each task to `out`."""
    artifacts.check_vacant(out, overwrite)
    config = config or RobotEvaluateConfig()
    described = load_robot(robot)
    found = evaluate_robot(described, plants_of(described), config, lambda done, note: progress("robot", done, note))
    result = {**found.figures, "configuration": config.model_dump(mode="json")}

    def write(folder: Path) -> None:
        artifacts.write_file(folder / "robot.json", artifacts.dump_json(result))
        for task, record in found.records.items():
            write_page(folder / f"{task}.html", described, record, _title(described, task, config.dead))
        draw_trials(folder, found.records)

    artifacts.write_folder(out, write, overwrite)
    return result


class RobotViewConfig(Configuration):
    """Configuration of a view of a robot."""

    task: str = "hold"
    """hold, lemniscate or lissajous."""
    evaluation: RobotEvaluateConfig = RobotEvaluateConfig(hold_s=60, settled_s=15, path_s=100)
    """Trial that is shown."""


def view(robot: str, out: Path, config: RobotViewConfig | None = None, *, overwrite: bool = False,
         progress: Progress = silent) -> dict[str, Any]:  # fmt: skip
    """Show one trial as a page in three dimensions."""
    config = config or RobotViewConfig()
    if out.suffix != ".html":
        raise ConfigurationError(f"{out}: a robot is shown as a page; give a name that ends in .html")
    artifacts.check_file(out, overwrite)
    if config.task not in TITLES:
        raise ConfigurationError(f"task {config.task!r}: there are {', '.join(TITLES)}")
    described = load_robot(robot)
    plants = plants_of(described)
    progress("robot", 0.0, "gaits of the fins")
    gaits = gaits_of(plants)
    progress("robot", 0.3, config.task)
    simulation = RobotSimulation(described, plants)
    record, row = trial(described, simulation, gaits, config.task, config.evaluation, config.evaluation.seed)
    write_page(out, described, record, _title(described, config.task, config.evaluation.dead))
    progress("robot", 1.0, "")
    return row


def _title(robot: RobotConfig, task: str, dead: bool) -> str:
    return f"{robot.name} {TITLES[task]}" + (" when a fin dies" if dead else "")


def plants_of(robot: RobotConfig) -> list[Plant]:
    """Build the plant of each fin; fins of one name share one."""
    limited = [name for name, fin in robot.fins.items() if fin.range_rad is not None]
    if limited:
        raise ConfigurationError(f"robot {robot.name}: {', '.join(limited)} turns within a range; the simulation knows "
                                 "fins that turn all the way round: leave range_rad out")  # fmt: skip
    built: dict[str, Plant] = {}
    for fin in robot.fins.values():
        if fin.plant not in built:
            built[fin.plant] = find_plant(fin.plant)
    return [built[fin.plant] for fin in robot.fins.values()]
