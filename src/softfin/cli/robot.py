"""``robot``: a body with several fins; what it can do, how well it holds and follows, a page, a
node of ROS 2."""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from softfin.cli.common import Configured, on_terminal
from softfin.cli.options import Option
from softfin.core.choices import RobotTask, TransportName
from softfin.core.errors import ConfigurationError


class RobotArguments(Configured):
    """Check, evaluate or show a robot with several fins, or share wrenches among real ones as a ROS
    2 node."""

    action: Annotated[Literal["check", "evaluate", "view", "ros2"], Option(positional=True)]
    """check: rank, singular values, reach and stability; evaluate: wrenches, holding and paths in
    simulation, as JSON, figures and pages; view: one trial as a page in three dimensions; ros2: a
    node that takes wrenches and asks the fins' nodes for forces; it moves nothing by itself, Enter
    or a topic stops it and the fins (docs/robot.md)."""
    robot: Annotated[str, Option("ROBOT", positional=True)] = "ucat"
    """The robot: ucat, or a YAML file."""
    out: Annotated[Path, Option("PATH")] | None = None
    """Folder that evaluate writes (runs/robot), or page that view writes (robot.html)."""
    wrenches: bool = False
    """With evaluate: mean wrenches on a body that is held. Without any task, all are evaluated."""
    hold: bool = False
    """With evaluate or view: hold a place against a push and a current."""
    lemniscate: bool = False
    """With evaluate or view: follow a figure of eight."""
    lissajous: bool = False
    """With evaluate or view: follow a three-dimensional Lissajous curve."""
    dead: bool = False
    """A fin dies at a random moment, each in turn."""
    baselines: bool = False
    """With evaluate: the same with simpler drivers."""
    seeds: int | None = None
    """With evaluate: repetitions of each trial (5)."""
    seed: int | None = None
    """Seed of noise and disturbances (0)."""
    transport: TransportName | None = None
    """With ros2: auto: rclpy where it is installed, else DDS without ROS 2."""
    domain: int | None = None
    """With ros2: ROS domain (the variable ROS_DOMAIN_ID, else 0)."""
    network: str | None = None
    """With ros2 and DDS: the network interface, as eth0, whose others may read and write the
    topics; else this computer alone."""

    def check(self) -> None:
        """Refuse tasks that do not go with the action."""
        super().check()
        if self.action in ("check", "ros2") and self._tasks():
            raise ConfigurationError(
                f"--{self._tasks()[0]}: robot {self.action} runs no trial; see robot evaluate"
            )
        for option, actions in (
            ("baselines", ("evaluate",)),
            ("dead", ("evaluate", "view")),
        ):
            if getattr(self, option) and self.action not in actions:
                raise ConfigurationError(
                    f"--{option} goes with robot {' and robot '.join(actions)}"
                )
        if self.action == "view" and (len(self._tasks()) > 1 or self.wrenches):
            raise ConfigurationError("robot view shows one of --hold, --lemniscate, --lissajous")

    def _tasks(self) -> tuple[RobotTask, ...]:
        names: tuple[RobotTask, ...] = ("wrenches", "hold", "lemniscate", "lissajous")
        return tuple(name for name in names if getattr(self, name))

    def __call__(self) -> None:
        actions = {
            "check": self._check,
            "evaluate": self._evaluate,
            "view": self._view,
            "ros2": self._ros2,
        }
        actions[self.action]()

    def _check(self) -> None:
        from softfin.stages.robot import check_robot_file

        found = check_robot_file(self.robot)
        lines = [
            f"{found['robot']}: {found['fins']} fins, rank {found['rank']} of 6",
            "singular values  " + "  ".join(f"{value:.3f}" for value in found["singular_values"]),
            *(f"without {name}: rank {rank}" for name, rank in found["rank_without"].items()),
            "mean force of each fin  "
            + ", ".join(f"{name} {n:.2f} N" for name, n in found["fin_reach_n"].items()),
            *(
                f"{name:6} up to {most:5.2f} {'N' if i < 3 else 'N m'} "
                f"({found['acceleration'][name]:.2f} {'m/s2' if i < 3 else 'rad/s2'} from rest)"
                for i, (name, most) in enumerate(found["reach"].items())
            ),
        ]
        if abs(found["sinks_n"]) > 1e-3:
            lines.append(
                f"{'sinks' if found['sinks_n'] > 0 else 'rises'} with {abs(found['sinks_n']):.2f} N"
            )
        if found["swing_hz"]:
            swings = " and ".join(
                f"{name} at {hz:.2f} Hz" for name, hz in found["swing_hz"].items()
            )
            lines.append(f"righted with {found['righting_nm_rad']:.2f} N m/rad: swings in {swings}")
        lines.extend(f"warning: {problem}" for problem in found["problems"])
        self.tell(found, "\n".join(lines))

    def _evaluate(self) -> None:
        from softfin.robot.evaluate import RobotEvaluateConfig
        from softfin.stages.robot import evaluate

        config = self.configured(
            RobotEvaluateConfig(),
            tasks=self._tasks(),
            dead=self.dead or None,
            baselines=self.baselines or None,
        )
        out = self.out or Path("runs/robot")
        found = self.stage(evaluate, self.robot, out, config)
        self.tell(found, "\n".join([*_table(found), f"{out}: pages, figures and robot.json"]))

    def _view(self) -> None:
        from softfin.stages.robot import VIEWED, view

        config = self.configured(VIEWED, tasks=self._tasks(), dead=self.dead or None)
        out = self.out or Path("robot.html")
        row = self.stage(view, self.robot, out, config)
        self.tell(
            row,
            f"{out}: {config.tasks[0]}, off by {100 * row['position_rms_m']:.1f} cm rms; open it "
            "in a browser",
        )

    def _ros2(self) -> None:
        from softfin.cli.driving import say, typed
        from softfin.rig.ros2.config import RobotNodeConfig
        from softfin.rig.ros2.plant import open_transport
        from softfin.rig.ros2.robot import RobotNode
        from softfin.rig.stop import StopRequest, listen_to_keyboard, stopped_by_signals
        from softfin.robot.description import load_robot

        options = {"transport": self.transport, "domain": self.domain, "network": self.network}
        given = {name: value for name, value in options.items() if value is not None}
        config = self.configured(RobotNodeConfig(), connection=given or None)
        robot = load_robot(self.robot)
        transport = open_transport(config.connection)
        request = StopRequest()
        try:
            node = RobotNode(transport, robot, config, say)
            for note in transport.notes:
                say(note)
            if on_terminal():
                line = "wrenches come by their topic; Enter alone stops the fins"
                listen_to_keyboard(request, lambda _: say(line), typed(request, sys.stdin))
            with stopped_by_signals(request):
                node.run(request)
        finally:
            transport.close()


def _table(found: dict[str, Any]) -> list[str]:
    from softfin.cli.tables import aligned

    lines = []
    if (row := found.get("wrenches")) is not None:
        lines.append(
            f"{row['count']} wrenches, mean over 2 s: off by {row['force_error_n']:.3f} N and "
            f"{row['moment_error_nm']:.3f} N m (worst {row['force_error_worst_n']:.3f} N, "
            f"{row['moment_error_worst_nm']:.3f} N m); ripple of roll "
            f"{row['roll_ripple_ratio']:.2f} of that with independent phases"
        )
    trials = {task: found[task] for task in ("hold", "lemniscate", "lissajous") if task in found}
    if trials:
        cells = [["", "seed", "off [cm rms]", "worst", "tilt [deg rms]", "worst", ""]]
        for task, rows in trials.items():
            for row in rows:
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
        lines.append("\n".join(aligned(cells, (0, 6))))
    if "baselines" in found:
        titles = ("mean over seeds", "force [N]", "moment [N m]", "roll ripple [N m]")
        cells = [[*titles, *(f"{task} [cm; deg]" for task in trials)]]
        for name, row in found["baselines"].items():
            scores = row["wrenches"]
            errors = (
                [
                    sum(each[score] for each in row[task]) / len(row[task])
                    for score in ("position_rms_m", "attitude_rms_deg")
                ]
                for task in trials
            )
            cells.append(
                [
                    name,
                    f"{scores['force_error_n']:.3f}",
                    f"{scores['moment_error_nm']:.3f}",
                    f"{scores['ripple']['roll']:.2f}",
                    *(f"{100 * off:.1f}; {tilt:.1f}" for off, tilt in errors),
                ]
            )
        lines.append("\n".join(aligned(cells)))
    return lines
