"""Baseline drivers, which show the benefit of allocation, phases and measured gaits."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.randomness import named_generator
from softfin.gaits.inverse_model import InverseConfig, find_amplitude
from softfin.robot.description import RobotConfig
from softfin.robot.fin_driver import FinGaits
from softfin.robot.phases import NUM_PHASES
from softfin.robot.wrench_driver import WrenchDriver

MakeDriver: TypeAlias = Callable[[int], WrenchDriver]
"""Function that builds a trial's driver from the seed."""

STROKE_HZ = PAPER_CLOCK.rate_hz / 2
FORCES_N = np.linspace(0, 12, 49)
"""Forces at which the inverse model is evaluated [N]."""


def build_drivers(robot: RobotConfig, gaits: Sequence[FinGaits]) -> dict[str, MakeDriver]:
    """Return the drivers by name, simplest last.

    In `still water`, fins do not compensate for the force lost through the robot's motion.
    Independent phases are drawn for every trial. `pseudo-inverse` allocates a wrench by least
    squares, without bracing. `analytic` is the driver of the U-CAT robots, with its amplitude law
    at our stroke frequency.
    """
    still = [each._replace(stream_loss=np.zeros_like(each.stream_loss)) for each in gaits]
    plain = robot.merged({"allocation": {"brace_n": 0, "smoothing": 0}}, "baseline")
    analytic = [_analytic(each) for each in gaits]

    def independent(seed: int) -> np.ndarray:
        return named_generator(seed, "robot/phases").integers(0, NUM_PHASES, len(gaits))

    return {
        "whole": lambda seed: WrenchDriver(robot, gaits),
        "still water": lambda seed: WrenchDriver(robot, still),
        "without phases": lambda seed: WrenchDriver(robot, gaits, independent(seed)),
        "pseudo-inverse": lambda seed: WrenchDriver(plain, gaits, independent(seed)),
        "analytic": lambda seed: WrenchDriver(plain, analytic, independent(seed)),
    }


def _analytic(gaits: FinGaits) -> FinGaits:
    """Return gaits that combine the inverse model's amplitudes, up to its maximum, with the limits
    and ripple of a fin's own gaits."""
    model = InverseConfig()
    amplitude = find_amplitude(FORCES_N, STROKE_HZ, model.constant)
    count = max(2, int((amplitude <= model.amplitude_max_rad).sum()))
    amplitude = np.maximum(amplitude[:count], model.amplitude_min_rad)
    ripple = np.stack(
        [np.interp(amplitude, gaits.amplitude, part) for part in gaits.ripple.T], axis=1
    )
    return FinGaits(FORCES_N[:count], amplitude, ripple, np.zeros((count, 2)), gaits.limits)
