"""Commands for a robot with several fins."""

import sys
from pathlib import Path
from typing import Annotated, TypeAlias

from softfin.cli.common import (
    CommandOptions,
    Configured,
    NodeOptions,
    Out,
    Repeats,
    folder_option,
    plant,
)
from softfin.cli.options import Option
from softfin.cli.output import progress
from softfin.core.json_object import JsonObject

Robot: TypeAlias = Annotated[str, Option("ROBOT", positional=True)]
Controllers: TypeAlias = Annotated[tuple[Path, ...], folder_option("controller", positional=True)]
Plants: TypeAlias = Annotated[tuple[str, ...], plant()]


class RobotCheckArguments(CommandOptions):
    """Check a robot with several fins: rank, singular values, reach and stability."""

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""
    max_thrust: float | None = None
    """Maximum mean force that each fin can produce in every direction [N]."""

    def __call__(self) -> None:
        from softfin.robot.check import check_robot
        from softfin.robot.description import load_robot, max_thrust_per_fin

        robot = load_robot(self.robot)
        found = check_robot(robot, max_thrust_per_fin(robot, self.max_thrust))
        lines = _reach_lines(found)
        if abs(found["sinks_n"]) > 1e-3:
            lines.append(
                f"{'sinks' if found['sinks_n'] > 0 else 'rises'} with {abs(found['sinks_n']):.2f} N"
            )
        if found["swing_hz"]:
            swings = " and ".join(
                f"{name} at {hz:.2f} Hz" for name, hz in found["swing_hz"].items()
            )
            lines.append(
                f"self-righting with {found['righting_nm_rad']:.2f} N m/rad: oscillates in {swings}"
            )
        lines.extend(f"warning: {problem}" for problem in found["problems"])
        self.tell(found, "\n".join(lines))


class RobotEvaluateArguments(Configured):
    """Evaluate a robot's ROS 2 node in simulation: wrench errors of fins in a tank, on a fixed
    body."""

    robot: Robot
    """Name of a robot, or its YAML file."""
    controller: Controllers
    """Controller folder: one for all fins, or one for each fin in the order of the robot's file."""
    plant: Plants = ("tank",)
    """Tank in which the fins beat, or its YAML file: one for all fins, or one for each fin."""
    out: Out = Path("runs/robot")
    """Output folder."""
    max_thrust: float | None = None
    """Maximum mean force that each fin can produce in every direction [N]."""
    targets: int | None = None
    """Number of random target wrenches (default: 20)."""
    dead: str | None = None
    """Name of a fin that is dead (default: none)."""
    repeats: Repeats | None = None
    """Repetitions of each target (default: 5)."""
    seed: int | None = None
    """Seed for targets, starting times and sensors (default: 0)."""

    def __call__(self) -> None:
        from softfin.robot.evaluate import RobotEvaluateConfig
        from softfin.stages.robot import evaluate

        config = self.configured(RobotEvaluateConfig(), dead=self.dead)
        with progress() as report:
            found = evaluate(
                self.robot,
                self.controller,
                self.out,
                config,
                plants=self.plant,
                overwrite=self.overwrite,
                progress=report,
            )
        self.tell(found, "\n".join([*_error_table(found), f"{self.out}: robot.json"]))


class RobotRos2Arguments(NodeOptions):
    """Run a ROS 2 node that distributes the wrenches from a topic among the fins of a robot.

    The node publishes a reference force for each fin's own node (softfin ros2 --fin NAME) and moves
    nothing itself. Enter or a topic stops the node and the fins. See docs/robot.md.
    """

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""
    max_thrust: float | None = None
    """Maximum mean force that each fin can produce in every direction [N]."""

    def __call__(self) -> None:
        from softfin.rig.arming import on_terminal, say, typed
        from softfin.rig.ros2.plant import open_transport
        from softfin.rig.stop import StopRequest, listen_to_keyboard, stopped_by_signals
        from softfin.robot.description import load_robot
        from softfin.robot.node import RobotNode
        from softfin.robot.node_config import RobotNodeConfig

        config = self.configured(RobotNodeConfig(), connection=self.connection)
        robot = load_robot(self.robot)
        transport = open_transport(config.connection)
        request = StopRequest()
        try:
            node = RobotNode(transport, robot, config, say)
            for note in transport.notes:
                say(note)
            if on_terminal():
                line = "wrenches come from the topic; press Enter alone to stop the fins"
                listen_to_keyboard(request, lambda _: say(line), typed(request, sys.stdin))
            with stopped_by_signals(request):
                node.run(request)
        finally:
            transport.close()


def _reach_lines(found: JsonObject) -> list[str]:
    """Return a robot's rank, singular values, and largest forces and moments."""
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
        unit, acceleration_unit = ("N", "m/s2") if index < 3 else ("N m", "rad/s2")
        acceleration = found["acceleration"][name]
        lines.append(
            f"{name:6} up to {most:5.2f} {unit} ({acceleration:.2f} {acceleration_unit} from rest)"
        )
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
        lines.append(f"{found['targets_given_up']} targets are out of the fins' reach")
    if found["references_unreachable"]:
        lines.append(
            f"{found['references_unreachable']:.0%} of the references are unreachable for their "
            "fin, which tracks the nearest reachable force instead"
        )
    return lines
