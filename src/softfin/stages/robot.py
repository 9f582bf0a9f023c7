"""Stage for robots with several fins: evaluation of a robot's node in simulation."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.robot.description import RobotConfig, load_robot
from softfin.robot.evaluate import RobotEvaluateConfig, SimulatedFin, evaluate_robot
from softfin.stages.evaluation import check_limits
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.tank import Tank


def evaluate(
    robot: str,
    controllers: Sequence[Path],
    out: Path,
    config: RobotEvaluateConfig,
    *,
    plants: Sequence[str] = ("tank",),
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Evaluate a robot's node in simulation; writes ``robot.json`` to `out`.

    `controllers` are one controller for all fins, or one for each fin in the order of the robot's
    file; `plants` are their tanks.
    """
    artifacts.check_vacant(out, overwrite)
    body = load_robot(robot)
    fins = simulated_fins(body, controllers, plants)
    found = evaluate_robot(body, fins, config, partial(progress, "robot"))
    result = {
        **artifacts.head("robot"),
        **found,
        "controllers": [str(controller) for controller in controllers],
        "plants": list(plants),
        "configuration": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=config.seed),
    }
    artifacts.write_folder(
        out, lambda folder: artifacts.write_description(folder, "robot", result), overwrite
    )
    return result


def simulated_fins(
    robot: RobotConfig, controllers: Sequence[Path], plants: Sequence[str]
) -> list[SimulatedFin]:
    """Load the controller and the tank of each fin: one for all, or one for each.

    Raises ConfigurationError for a wrong number of them and for a plant that is not a tank, and
    PlantError for a controller that exceeds its tank's limits.
    """
    count = len(robot.fins)
    for given, what in ((controllers, "controllers"), (plants, "plants")):
        if len(given) not in (1, count):
            raise ConfigurationError(
                f"robot {robot.name}: got {len(given)} {what}; use one for all fins, or one for "
                f"each of {', '.join(robot.fins)}"
            )
    fins = []
    for index in range(count):
        path = controllers[index % len(controllers)]
        plant = plants[index % len(plants)]
        controller = load_controller(path)
        tank = find_plant(plant)
        if not isinstance(tank, Tank):
            raise ConfigurationError(
                f"plant {plant}: only a tank simulates the torque about the shaft of a robot's "
                "fin; use tank, or the YAML file of a tank"
            )
        check_limits(controller.limits, tank.limits, path, plant)
        fins.append(SimulatedFin(controller, tank))
    return fins
