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
    """Name of this fin; None where it was not given."""
    settle_s: float = 5.0
    """Time for which the fin rests before each log or experiment [s]."""
    configuration: JsonObject = field(default_factory=dict)
    """The whole configuration, for JSON."""
    warning: str | None = None
    """Warning about a machine that is not commissioned."""

    def check_ready(self) -> None:
        """Raise RigError where an open machine must not move yet; only a machine that has such a
        check is checked."""
        check = getattr(self.machine, "check_ready", None)
        if check is not None:
            check()

    def check_fits(self, controller: str, limits: Limits, fin: str | None) -> None:
        """Raise RigError where a controller is for another fin, or commands more than this machine
        takes."""
        if None not in (fin, self.fin) and fin != self.fin:
            raise RigError(
                f"{controller}: trained for fin {fin!r}, but this rig has fin {self.fin!r}; train "
                "one for it, or correct 'fin' in the rig's file"
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
    """Find a machine by name, ``rig``, ``ros2`` or one of these with ``:FILE``, without opening it;
    raises RigError."""
    # Imported here: one kind of robot needs no libraries of the other.
    kind, _, file = name.partition(":")
    path = Path(file) if file else None
    if kind == "rig":
        from softfin.rig.commissioning.form import load_form
        from softfin.rig.config import load_rig
        from softfin.rig.rig import Rig

        rig = load_rig(path)
        # A real rig's configuration must stay as it was before emulated rigs existed.
        values = rig.model_dump(
            mode="json", exclude={"emulation"} if rig.emulation is None else None
        )
        # An emulated rig needs no commissioning.
        warning = (
            None
            if rig.emulation is not None or rig.file is None
            else load_form(rig.file).warning(rig)
        )
        return RobotSetup(Rig(rig), rig.safety, rig.fin, rig.settle_s, values, warning)
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
