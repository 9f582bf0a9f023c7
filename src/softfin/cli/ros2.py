"""``softfin ros2``: a controller on the real fin as a ROS 2 node: readings out, references and a stop in; no JAX."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from softfin.cli.common import Configured, force
from softfin.cli.live import Armed
from softfin.cli.run import follow
from softfin.deployment.bench import Bench, check_fits
from softfin.deployment.loop import Acting, Force
from softfin.deployment.native import load_native, trimmed
from softfin.deployment.recording import recording
from softfin.deployment.safety import Guard
from softfin.deployment.session import Session
from softfin.deployment.stop import Keyboard, StopRequest, stopped_by_signals
from softfin.errors import ConfigurationError
from softfin.live import is_live
from softfin.rig.find import find_bench
from softfin.rig.ros2_messages import Messages
from softfin.rig.ros2_node import NodeConfig, RosBridge, check_apart
from softfin.rig.ros2_plant import Ros2Machine
from softfin.rig.ros2_transport import open_transport


@dataclass(frozen=True, kw_only=True)
class Arguments(Armed, Configured):
    """Run as a ROS 2 node: hold the reference of a topic on the real fin, publish each sample; Enter or a topic stops.

    Topics, frames and the timeout of references: --set joint_topic=/NAME and so on (docs/rig.md has them all).
    """

    controller: tyro.conf.Positional[Path]
    """Folder of the controller."""
    reference: str
    """Reference force as --reference=X,Y in newton, while no other comes: at first, and when the last is too old."""
    plant: str = "rig"
    """The fin: rig (rig.yaml), ros2, or one of these with :FILE."""
    seconds: int | None = None
    """How long; without it until you stop it."""
    bag: Path | None = None
    """The recording, a ROS 2 bag (run-DATE.mcap)."""
    transport: Literal["auto", "rclpy", "dds"] | None = None
    """auto: rclpy where it is installed, else DDS without ROS 2."""
    domain: int | None = None
    """ROS domain (the variable ROS_DOMAIN_ID, else 0)."""
    network: str | None = None
    """With DDS: the network interface, as eth0, whose others may read and write the topics; else this computer alone.
    """
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is held, with a warning."""
    trim: bool = False
    """Take off, slowly, what the fin makes besides what it is asked for, from the measured mean force."""

    def run(self) -> None:
        """Run."""
        if not is_live(self.plant):
            raise ConfigurationError(f"--plant {self.plant}: is simulated; softfin evaluate judges a controller there")
        options = {"transport": self.transport, "domain": self.domain, "network": self.network}
        given = {name: value for name, value in options.items() if value is not None}
        topics = self.configured(NodeConfig(), connection=given or None)
        controller = load_native(self.controller)
        bench = find_bench(self.plant)
        check_fits(str(self.controller), controller.limits, controller.fin, bench)
        if isinstance(bench.machine, Ros2Machine):
            check_apart(topics, bench.machine.config)
        otherwise, warning = controller.admit(force(self.reference), self.strict)
        transport = open_transport(topics.connection, Messages())
        try:
            bridge = RosBridge(transport, topics, admit=lambda asked: controller.admit(asked, self.strict))
            for note in (*transport.notes, *([] if warning is None else [warning])):
                _say(note)
            acting = trimmed(controller) if self.trim else controller
            guard = Guard(bench.safety, bench.machine.limits, controller.training_range)
            self._hold(acting, bench, guard, bridge, otherwise)
        finally:
            transport.close()

    def _hold(self, acting: Acting, bench: Bench, guard: Guard, bridge: RosBridge, otherwise: Force) -> None:
        bag = self.bag or Path(f"run-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
        request = StopRequest()
        newest = bridge.references(otherwise)

        def references(at: float) -> Force:
            asked = newest(at)
            for note in bridge.notes():
                _say(note)
            return asked

        with Session(bench.machine, guard, stop=request, observers=(bridge.observer(request),)) as session:
            self.confirm(bench)
            if sys.stdin.isatty():
                Keyboard(request, lambda _: _say("references come by their topic; Enter alone stops the fin")).start()
            with stopped_by_signals(request), recording(session, bag):
                session.activate()
                session.rest(bench.settle_s)
                summary = follow(session, acting, references, self.seconds, _say)
                session.deactivate()
            counters = bench.machine.counters() | bridge.counters()
            clock = session.pace.described()
        result = {"bag": str(bag), **summary, "clock": clock, "counters": counters}
        self.tell(result, f"{bag}: {summary['seconds']:.1f} s, error over the last 2 s "
                  f"({summary['error_x_n']}, {summary['error_y_n']}) N")  # fmt: skip


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
