"""Finds a real fin by name (``rig`` or ``ros2``), or a rig by its configuration; the rig may be
emulated."""

from pathlib import Path

from softfin.core.errors import RigError
from softfin.rig.config import RigConfig, load_rig, load_ros2
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.storage.registry import LIVE


def find_rig(config: RigConfig) -> Rig:
    """Return the rig with a configuration without opening it; raises RigError if the configuration
    is unusable."""
    if config.emulation is None:
        return Rig(config)
    # Imported here because a real rig does not need the tank.
    from softfin.emulation.rig import kept_rig

    return kept_rig(config).connect(config)


def find_robot(name: str) -> RobotSetup:
    """Return the machine with a name (``rig`` or ``ros2``, optionally followed by ``:FILE``)
    without opening it; raises RigError if it is unusable."""
    # Imported here because each kind needs only its own libraries.
    kind, _, file = name.partition(":")
    path = Path(file) if file else None
    if kind == "rig":
        rig = load_rig(path)
        values = rig.model_dump(mode="json")
        return RobotSetup(find_rig(rig), rig.safety, rig.fin, rig.settle_s, rig.feedback, values)
    if kind == "ros2":
        from softfin.rig.ros2.plant import Ros2Machine

        ros2 = load_ros2(path)
        machine = Ros2Machine(ros2.topics)
        return RobotSetup(
            machine,
            ros2.safety,
            ros2.fin,
            ros2.settle_s,
            ros2.feedback,
            ros2.model_dump(mode="json"),
        )
    raise RigError(
        f"plant {name}: not a real fin; use {' or '.join(LIVE)}, optionally with :FILE; "
        "for a simulated plant, use softfin evaluate"
    )
