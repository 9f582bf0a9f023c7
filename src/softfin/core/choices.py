"""Names and numbers that options and configurations accept, each defined once. No JAX."""

from typing import Literal, TypeAlias

# Other modules have tables with an entry for each name: PRESETS for reproductions and calibrations,
# SIGNALS for evaluations and UNITS for columns.
ReproducePreset: TypeAlias = Literal["demo", "best", "streaming", "paper", "tiny"]
CalibratePreset: TypeAlias = Literal["full", "quick"]
MovingReference: TypeAlias = Literal["step", "ramp", "sine"]
TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns", "min"]
ForceUnit: TypeAlias = Literal["N", "mN", "kN", "gf", "kgf", "lbf"]

PolicyLayout: TypeAlias = Literal["single", "grid"]
ControllerKind: TypeAlias = Literal["single", "grid", "gaits"]
"""One policy for all references, one policy per cell of a grid, or a table of gaits without a
policy."""

Algorithm: TypeAlias = Literal["gradient", "ppo"]
AlgorithmPreset: TypeAlias = Literal["gradient", "ppo", "ppo-hindsight"]
"""Gradients through the plant, plain LSTM-PPO as in the paper, or LSTM-PPO with hindsight
relabelling."""
AlgorithmOption: TypeAlias = Literal["auto", AlgorithmPreset]
"""Training algorithm of policies; auto uses gradients if the plant is differentiable, otherwise
LSTM-PPO with hindsight relabelling."""

EngineName: TypeAlias = Literal["local", "ray"]

TransportName: TypeAlias = Literal["auto", "rclpy", "dds"]
"""Transport of a ROS 2 node; auto uses rclpy if it is installed, otherwise DDS."""

LOOPBACK = "127.0.0.1"
"""Address that can be reached only from this computer."""

SEEDS = 2**31
"""Number of seeds; every random number generator accepts seeds from 0 to this number minus 1."""
