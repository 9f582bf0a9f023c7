"""Names of fins that move by themselves: ``rig``, ``ros2``, or one of these with ``:FILE``; no JAX here."""

from pathlib import Path

LIVE = ("rig", "ros2")
"""`softfin.rig.find` knows what they stand for."""


def is_live(name: str) -> bool:
    """Whether `name` stands for such a fin."""
    return name.partition(":")[0] in LIVE and not Path(name).exists()
