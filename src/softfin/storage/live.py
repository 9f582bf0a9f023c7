"""Names of plants that are no paths: a folder of the same name is written ``./tank``; no JAX here.

Fins that move by themselves are ``rig``, ``ros2``, or one of these with ``:FILE``.
"""

TANK = "tank"
"""The virtual tank."""

LIVE = ("rig", "ros2")
"""`softfin.rig.find` knows what they stand for."""


def is_live(name: str) -> bool:
    """Whether `name` stands for a fin that moves by itself."""
    return name.partition(":")[0] in LIVE
