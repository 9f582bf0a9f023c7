"""Names and numbers that options and configurations accept, each defined once. No JAX."""

from typing import Literal, TypeAlias

# Other modules have tables with an entry for each name: PRESETS for reproductions and calibrations,
# and UNITS for columns.
ReproducePreset: TypeAlias = Literal["demo", "paper", "tiny"]
CalibratePreset: TypeAlias = Literal["full", "quick"]
TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns", "min"]
ForceUnit: TypeAlias = Literal["N", "mN", "cN", "kN", "gf", "kgf", "lbf", "ozf"]

PolicyLayout: TypeAlias = Literal["single", "grid"]
"""Layout: one policy for all references, or one policy per grid cell."""
TrainingRangeName: TypeAlias = Literal["reach", "paper"]
"""References for training: all forces that the fin can produce, or the paper's references."""

TransportName: TypeAlias = Literal["auto", "rclpy", "dds"]
"""Transport of a ROS 2 node; auto uses rclpy if it is installed, otherwise DDS."""

LOOPBACK = "127.0.0.1"
"""Address that can be reached only from this computer."""

SEEDS = 2**31
"""Number of seeds; every random number generator accepts seeds from 0 to this number minus 1."""
