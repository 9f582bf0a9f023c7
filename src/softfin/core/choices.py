"""Names and numbers that options and configurations accept, each defined once; no JAX here."""

from typing import Literal, TypeAlias

# Each is covered by a table: PRESETS of reproductions and calibrations, SIGNALS of an evaluation,
# UNITS of columns.
ReproducePreset: TypeAlias = Literal["demo", "best", "streaming", "paper", "tiny"]
CalibratePreset: TypeAlias = Literal["full", "quick"]
MovingReference: TypeAlias = Literal["step", "ramp", "sine"]
TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns", "min"]
ForceUnit: TypeAlias = Literal["N", "mN", "kN", "gf", "kgf", "lbf"]

"""How the motions of a dataset are chosen."""

ModelName: TypeAlias = Literal["streaming", "paper"]
"""Kinds of surrogate that are fitted; auto keeps the best on held-out logs."""

PolicyLayout: TypeAlias = Literal["single", "grid"]
ControllerKind: TypeAlias = Literal["single", "grid", "gaits"]
"""One policy for all references, one for each cell of a grid, or a table of gaits without a
policy."""

Algorithm: TypeAlias = Literal["gradient", "ppo"]
AlgorithmPreset: TypeAlias = Literal["gradient", "ppo", "ppo-hindsight"]
"""Gradients through the plant, plain LSTM-PPO as in the paper, or LSTM-PPO with hindsight
relabelling."""
AlgorithmOption: TypeAlias = Literal["auto", AlgorithmPreset]
"""How policies are trained; auto uses gradients if the plant has them, otherwise LSTM-PPO with
hindsight relabelling."""

EngineName: TypeAlias = Literal["local", "ray"]

RobotTask: TypeAlias = Literal["wrenches", "hold", "lemniscate", "lissajous"]
"""Tasks on which a robot is evaluated."""

ViewedTask: TypeAlias = Literal["hold", "lemniscate", "lissajous"]
"""Tasks that have a motion to show on a page."""

TransportName: TypeAlias = Literal["auto", "rclpy", "dds"]
"""How a ROS 2 node reaches others; auto uses rclpy if it is installed, otherwise DDS."""

LOOPBACK = "127.0.0.1"
"""Address that only this computer can reach."""

SEEDS = 2**31
"""Largest seed; every random number generator accepts whole numbers from 0 to this one."""
