"""Commands for robots with several fins: check a robot, evaluate its node in simulation, and run
the node."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.option_types import CONNECTION, CONTROLLER, DIR, HIDDEN, PLANT, Config, PathLike
from softfin.core.power import describe_powers
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.rig.ros2.config import TransportConfig
from softfin.stages.driving import typed_fields
from softfin.storage import artifact as artifacts

if TYPE_CHECKING:
    from softfin.rig.ros2.connection import Transport
    from softfin.robot.description import RobotConfig
    from softfin.robot.evaluate import SimulatedFin
    from softfin.robot.node_config import RobotNodeConfig

ROBOT = Parameter(metavar="ROBOT")


def check(robot: Annotated[PathLike, ROBOT] = "ucat", *, max_thrust: float | None = None) -> Result:
    """Check a robot with several fins: rank, singular values and reach.

    Args:
        robot: Name of a robot, or its YAML file.
        max_thrust: Maximum mean force that each fin can produce in every direction [N].

    Returns:
        Rank, singular values, and largest forces and moments.
    """
    from softfin.robot.check import check_robot
    from softfin.robot.description import load_robot, max_thrust_per_fin

    body = load_robot(str(robot))
    found = check_robot(body, max_thrust_per_fin(body, max_thrust))
    return Result(found, "\n".join(_reach_lines(found)))


def evaluate(
    robot: Annotated[PathLike, ROBOT],
    *controllers: Annotated[PathLike, CONTROLLER],
    plant: Annotated[tuple[str, ...], PLANT] = ("tank",),
    out: Annotated[PathLike, DIR] = "runs/robot",
    max_thrust: float | None = None,
    targets: int | None = None,
    dead: str | None = None,
    repeats: int | None = None,
    seed: int | None = None,
    config: Config = None,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Evaluate the ROS 2 node of a robot in simulation: wrench errors of fins in a tank, on a fixed
    body.

    Args:
        robot: Name of a robot, or its YAML file.
        controllers: Controller folder: one for all fins, or one for each fin in the order of the
            robot file.
        plant: Tank in which the fins beat, or its YAML file: one for all fins, or one for each fin.
        out: Output folder.
        max_thrust: Maximum mean force that each fin can produce in every direction [N].
        targets: Number of random target wrenches (default: 20).
        dead: Name of a fin that is dead (default: none).
        repeats: Repetitions of each target (default: 5).
        seed: Seed for targets, starting times and sensors (default: 0).
        config: `RobotEvaluateConfig`; its fields are options too.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        The contents of robot.json.
    """
    out = Path(out)
    artifacts.check_vacant(out, overwrite, kind="robot")
    paths = [Path(controller) for controller in controllers]
    for path in paths:
        artifacts.find_description(path, "controller")
    from softfin.robot.description import load_robot
    from softfin.robot.evaluate import RobotEvaluateConfig, evaluate_robot

    settings = configure(
        RobotEvaluateConfig(),
        config,
        max_thrust=max_thrust,
        targets=targets,
        dead=dead,
        repeats=repeats,
        seed=seed,
    )
    body = load_robot(str(robot))
    fins = simulated_fins(body, paths, plant)
    found = evaluate_robot(body, fins, settings, partial(progress, "robot"))
    result = {
        **artifacts.head("robot"),
        **found,
        "controllers": [str(path) for path in paths],
        "plants": list(plant),
        "configuration": settings.model_dump(mode="json"),
        "provenance": artifacts.provenance(seed=settings.seed),
    }
    artifacts.write_folder(
        out, lambda folder: artifacts.write_description(folder, "robot", result), overwrite
    )
    return Result(
        result,
        "\n".join([*_error_table(result), describe_powers(result["power"]), f"{out}: robot.json"]),
    )


def ros2(
    robot: Annotated[PathLike, ROBOT] = "ucat",
    *,
    max_thrust: float | None = None,
    config: Config = None,
    connection: Annotated[TransportConfig | None, CONNECTION] = None,
) -> None:
    """Run a ROS 2 node that distributes the wrenches from a topic among the fins of a robot.

    The node publishes a reference force for the node of each fin (softfin ros2 --fin NAME) and
    moves nothing itself. Enter or a topic stops the node and the fins. See docs/robot.md.

    Args:
        robot: Name of a robot, or its YAML file.
        max_thrust: Maximum mean force that each fin can produce in every direction [N].
        config: `RobotNodeConfig`; its fields are options too.
        connection: How to reach other nodes.
    """
    from softfin.rig.ros2.plant import open_transport
    from softfin.robot.description import load_robot
    from softfin.robot.node_config import RobotNodeConfig

    settings = configure(
        RobotNodeConfig(), config, max_thrust=max_thrust, connection=typed_fields(connection)
    )
    body = load_robot(str(robot))
    transport = open_transport(settings.connection)
    try:
        run_robot(transport, body, settings)
    finally:
        transport.close()


def run_robot(transport: "Transport", robot: "RobotConfig", settings: "RobotNodeConfig") -> None:
    """Distribute wrenches until Enter, a signal or a topic stops the node, which raises
    SafetyStop."""
    from softfin.rig.arming import on_terminal, say, typed
    from softfin.rig.stop import StopRequest, listen_to_keyboard, stopped_by_signals
    from softfin.robot.node import RobotNode

    request = StopRequest()
    with stopped_by_signals(request):
        node = RobotNode(transport, robot, settings, say)
        for note in transport.notes:
            say(note)
        if on_terminal():
            line = "wrenches come from the topic; press Enter alone to stop the fins"
            listen_to_keyboard(request, lambda _: say(line), typed(request, sys.stdin))
        node.run(request)


def simulated_fins(
    robot: "RobotConfig", controllers: Sequence[Path], plants: Sequence[str]
) -> "list[SimulatedFin]":
    """Load the controller and the tank of each fin; there is one for all fins or one per fin.

    Raises ConfigurationError if the number of controllers or tanks is wrong or a plant is not a
    tank, and PlantError if a controller exceeds the limits of its tank.
    """
    from softfin.control.store import load_controller
    from softfin.evaluation.evaluate import check_limits
    from softfin.robot.evaluate import SimulatedFin
    from softfin.storage.registry import find_plant
    from softfin.tank import Tank

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
                f"plant {plant}: only a tank simulates the torque about the shaft of a robot fin; "
                "use tank, or the YAML file of a tank"
            )
        check_limits(controller.limits, tank.limits, path, plant)
        fins.append(SimulatedFin(controller, tank))
    return fins


def _reach_lines(found: JsonObject) -> list[str]:
    """Return the rank, the singular values, and the largest forces and moments of a robot."""
    singular_values = "  ".join(map("{:.3f}".format, found["singular_values"]))
    lines = [
        f"{found['robot']}: {found['fins']} fins, rank {found['rank']} of 6",
        f"singular values  {singular_values}",
    ]
    for name, rank in found["rank_without"].items():
        lines.append(f"without {name}: rank {rank}")
    reach = ", ".join(f"{name} {force:.2f} N" for name, force in found["max_thrust_n"].items())
    lines.append(f"maximum mean force of each fin  {reach}")
    # Three forces, then three moments.
    for index, (name, most) in enumerate(found["reach"].items()):
        lines.append(f"{name:6} up to {most:5.2f} {'N' if index < 3 else 'N m'}")
    return lines


def _error_table(found: JsonObject) -> list[str]:
    """Return the wrench errors of an evaluation, one line per axis."""
    from softfin.stages.tables import aligned

    config = found["configuration"]
    fins = "all fins" if found["dead"] is None else f"{found['dead']} dead"
    cells = [["", "", "target", "error", "worst", "of references", "ripple"]]
    # Three forces, then three moments.
    for index, name in enumerate(found["error"]):
        columns = ("target", "error", "error_worst", "error_of_references", "ripple")
        values = [f"{found[column][name]:.3f}" for column in columns]
        cells.append([name, "N" if index < 3 else "N m", *values])
    lines = [
        f"{found['robot']}, {fins}: {config['targets']} target wrenches, {config['repeats']} times "
        f"{found['seconds']:g} s; means of the absolute values",
        *aligned(cells, (0, 1)),
    ]
    if found["targets_given_up"]:
        lines.append(f"{found['targets_given_up']} targets are out of reach of the fins")
    if found["references_unreachable"]:
        lines.append(
            f"{found['references_unreachable']:.0%} of the references are unreachable for their "
            "fin, which tracks the nearest reachable force instead"
        )
    return lines
