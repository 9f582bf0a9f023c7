"""Which machine a name stands for: ``rig`` (``rig.yaml``), ``ros2``, or one of these with ``:FILE``."""

from pathlib import Path

from softfin.core.errors import RigError
from softfin.rig.bench import Bench
from softfin.storage.registry import LIVE


def find_bench(name: str) -> Bench:
    """The machine, not yet open, and how to treat it; raises RigError naming what is wrong with its file."""
    kind, _, file = name.partition(":")
    if kind == "rig":
        return rig_bench(Path(file) if file else None)
    if kind == "ros2":
        return ros2_bench(Path(file) if file else None)
    raise RigError(f"{name}: no machine; give {' or '.join(LIVE)}, or one of these with :FILE")


def rig_bench(file: Path | None = None) -> Bench:
    """The rig of a file."""
    from softfin.rig.config import load_rig
    from softfin.rig.rig import Rig

    config = load_rig(file)
    # A real rig is described as it always was.
    described = config.model_dump(mode="json", exclude={"emulation"} if config.emulation is None else None)
    return Bench(Rig(config), config.safety, config.fin, config.settle_s, described)


def ros2_bench(file: Path | None = None) -> Bench:
    """The fin made of topics that a file describes."""
    from softfin.rig.config import load_ros2
    from softfin.rig.ros2.plant import Ros2Machine

    config = load_ros2(file)
    machine = Ros2Machine(config.topics)
    return Bench(machine, config.safety, config.fin, config.settle_s, config.model_dump(mode="json"))
