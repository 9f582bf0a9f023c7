"""Commands for a robot with several fins."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

from softfin.cli.common import (
    CommandOptions,
    Configured,
    File,
    NodeOptions,
    Out,
    Repeats,
    on_terminal,
    progress,
)
from softfin.cli.options import Option
from softfin.core.choices import RobotTask, ViewedTask
from softfin.core.json_object import JsonObject

Robot: TypeAlias = Annotated[str, Option("ROBOT", positional=True)]


class RobotCheckArguments(CommandOptions):
    """Check a robot with several fins: rank, singular values, reach and stability."""

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""

    def __call__(self) -> None:
        from softfin.stages.robot import check_robot_file

        found = check_robot_file(self.robot)
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
    """Evaluate a robot in simulation: wrenches, station keeping and path following. Writes JSON,
    figures and HTML pages."""

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""
    out: Out = Path("runs/robot")
    """Output folder."""
    task: tuple[RobotTask, ...] = ()
    """wrenches: mean wrenches on a fixed body; hold: hold position against a push and a current;
    lemniscate: follow a figure eight; lissajous: follow a three-dimensional curve (default: all
    four)."""
    dead: bool = False
    """Let one fin fail at a random time, each fin in turn."""
    baselines: bool = False
    """Also evaluate simpler controllers."""
    repeats: Repeats | None = None
    """Repetitions of each trial (default: 5)."""
    seed: int | None = None
    """Seed for noise and disturbances (default: 0)."""

    def __call__(self) -> None:
        from softfin.robot.evaluate import RobotEvaluateConfig
        from softfin.stages.robot import evaluate

        config = self.configured(
            RobotEvaluateConfig(),
            tasks=self.task,
            dead=self.dead or None,
            baselines=self.baselines or None,
            seeds=self.repeats,
        )
        with progress() as report:
            found = evaluate(
                self.robot, self.out, config, overwrite=self.overwrite, progress=report
            )
        self.tell(found, "\n".join([*_table(found), f"{self.out}: pages, figures and robot.json"]))


class RobotViewArguments(Configured):
    """Write an HTML page that shows one trial of a robot in 3D."""

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""
    out: File = Path("robot.html")
    """File to write."""
    task: ViewedTask | None = None
    """hold: hold position against a push and a current (default); lemniscate: follow a figure
    eight; lissajous: follow a three-dimensional curve."""
    dead: bool = False
    """Let one fin fail at a random time."""
    seed: int | None = None
    """Seed for noise and disturbances (default: 0)."""

    def __call__(self) -> None:
        from softfin.stages.robot import VIEWED, view

        tasks = () if self.task is None else (self.task,)
        config = self.configured(VIEWED, tasks=tasks, dead=self.dead or None)
        with progress() as report:
            row = view(self.robot, self.out, config, overwrite=self.overwrite, progress=report)
        self.tell(
            row,
            f"{self.out}: {config.tasks[0]}, RMS position error "
            f"{100 * row['position_rms_m']:.1f} cm; open it in a browser",
        )


class RobotRos2Arguments(NodeOptions):
    """Run a ROS 2 node that distributes the wrenches from a topic among the fins of a robot.

    The node publishes a reference force for each fin's own node (softfin ros2 --fin NAME) and moves
    nothing itself. Enter or a topic stops the node and the fins. See docs/robot.md.
    """

    robot: Robot = "ucat"
    """Name of a robot, or its YAML file."""

    def __call__(self) -> None:
        from softfin.cli.driving import say, typed
        from softfin.rig.ros2.config import RobotNodeConfig
        from softfin.rig.ros2.plant import open_transport
        from softfin.rig.ros2.robot import RobotNode
        from softfin.rig.stop import StopRequest, listen_to_keyboard, stopped_by_signals
        from softfin.robot.description import load_robot

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
    reach = ", ".join(f"{name} {force:.2f} N" for name, force in found["fin_reach_n"].items())
    lines.append(f"mean force of each fin  {reach}")
    # Three forces, then three moments.
    for index, (name, most) in enumerate(found["reach"].items()):
        unit, acceleration_unit = ("N", "m/s2") if index < 3 else ("N m", "rad/s2")
        acceleration = found["acceleration"][name]
        lines.append(
            f"{name:6} up to {most:5.2f} {unit} ({acceleration:.2f} {acceleration_unit} from rest)"
        )
    return lines


def _table(found: JsonObject) -> list[str]:
    lines = []
    if (row := found.get("wrenches")) is not None:
        lines.append(
            f"{row['count']} wrenches, mean over 2 s: error {row['force_error_n']:.3f} N and "
            f"{row['moment_error_nm']:.3f} N m (worst {row['force_error_worst_n']:.3f} N, "
            f"{row['moment_error_worst_nm']:.3f} N m); roll ripple "
            f"{row['roll_ripple_ratio']:.2f} times that with independent phases"
        )
    tasks = [task for task in ("hold", "lemniscate", "lissajous") if task in found]
    if tasks:
        lines.append(_trial_table(found, tasks))
    if "baselines" in found:
        lines.append(_baseline_table(found["baselines"], tasks))
    return lines


def _trial_table(found: JsonObject, tasks: Sequence[str]) -> str:
    from softfin.cli.tables import aligned

    cells = [["", "seed", "position [cm RMS]", "worst", "tilt [deg RMS]", "worst", ""]]
    for task in tasks:
        for row in found[task]:
            note = f"{row['dead']} dead at {row['dead_at_s']:.0f} s" if "dead" in row else ""
            cells.append(
                [
                    task,
                    str(row["seed"]),
                    f"{100 * row['position_rms_m']:.2f}",
                    f"{100 * row['position_worst_m']:.1f}",
                    f"{row['attitude_rms_deg']:.2f}",
                    f"{row['attitude_worst_deg']:.1f}",
                    note,
                ]
            )
    return "\n".join(aligned(cells, (0, 6)))


def _baseline_table(baselines: JsonObject, tasks: Sequence[str]) -> str:
    from softfin.cli.tables import aligned

    titles = ["mean over seeds", "force [N]", "moment [N m]", "roll ripple [N m]"]
    cells = [titles + [f"{task} [cm; deg]" for task in tasks]]
    for name, row in baselines.items():
        scores = row["wrenches"]
        line = [
            name,
            f"{scores['force_error_n']:.3f}",
            f"{scores['moment_error_nm']:.3f}",
            f"{scores['ripple']['roll']:.2f}",
        ]
        for task in tasks:
            off_m = _mean(row[task], "position_rms_m")
            tilt_deg = _mean(row[task], "attitude_rms_deg")
            line.append(f"{100 * off_m:.1f}; {tilt_deg:.1f}")
        cells.append(line)
    return "\n".join(aligned(cells))


def _mean(rows: Sequence[JsonObject], score: str) -> float:
    total: float = sum(row[score] for row in rows)
    return total / len(rows)
