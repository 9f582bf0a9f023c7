"""Look up a real plant by name, ``rig`` or ``ros2``: its machine, safety limits and rest time."""

from dataclasses import dataclass, field
from pathlib import Path

from softfin.core.errors import RigError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import Limits
from softfin.rig.machine import Machine
from softfin.rig.safety import SafetyConfig
from softfin.storage.registry import LIVE


@dataclass(frozen=True)
class RobotSetup:
    """A machine, its safety limits and its configuration."""

    machine: Machine
    safety: SafetyConfig
    fin: str | None = None
    """Name of this fin; None if unknown."""
    settle_s: float = 5.0
    """Rest time before each log or experiment [s]."""
    configuration: JsonObject = field(default_factory=dict)
    """Complete configuration, for JSON."""

    def check_ready(self) -> None:
        """Raise RigError if the open machine must not move yet, according to its own `check_ready`
        if it has one."""
        check = getattr(self.machine, "check_ready", None)
        if check is not None:
            check()

    def check_fits(self, controller: str, limits: Limits, fin: str | None) -> None:
        """Raise RigError if a controller is for another fin or exceeds this machine's limits."""
        if None not in (fin, self.fin) and fin != self.fin:
            raise RigError(
                f"{controller}: trained for fin {fin!r}, but this rig has fin {self.fin!r}; train "
                "a controller for this fin, or correct 'fin' in the rig's file"
            )
        for quantity, unit in (("angle", "rad"), ("velocity", "rad/s")):
            (low, high), (lowest, highest) = (
                (getattr(each, f"{quantity}_min"), getattr(each, f"{quantity}_max"))
                for each in (limits, self.machine.limits)
            )
            if low < lowest - 1e-3 or high > highest + 1e-3:
                raise RigError(
                    f"{controller}: commands a {quantity} of {low:.5g} .. {high:.5g} {unit}; "
                    f"{self.machine.name} accepts {lowest:.5g} .. {highest:.5g}; train it within "
                    "these limits, or widen the rig's"
                )


def find_robot(name: str) -> RobotSetup:
    """Return the machine with a name (``rig`` or ``ros2``, optionally followed by ``:FILE``)
    without opening it; raises RigError."""
    # Imported here because each kind needs only its own libraries.
    kind, _, file = name.partition(":")
    path = Path(file) if file else None
    if kind == "rig":
        from softfin.rig.config import load_rig
        from softfin.rig.rig import Rig

        rig = load_rig(path)
        # The configuration of a real rig must stay the same as before emulated rigs were added.
        values = rig.model_dump(
            mode="json", exclude={"emulation"} if rig.emulation is None else None
        )
        return RobotSetup(Rig(rig), rig.safety, rig.fin, rig.settle_s, values)
    if kind == "ros2":
        from softfin.rig.config import load_ros2
        from softfin.rig.ros2.plant import Ros2Machine

        ros2 = load_ros2(path)
        machine = Ros2Machine(ros2.topics)
        return RobotSetup(
            machine, ros2.safety, ros2.fin, ros2.settle_s, ros2.model_dump(mode="json")
        )
    raise RigError(
        f"plant {name}: not a real fin; use {' or '.join(LIVE)}, optionally with :FILE; "
        "for a simulated plant, use softfin evaluate"
    )
