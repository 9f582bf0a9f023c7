"""Policies with random weights."""

import numpy as np

from softfin.robot.residual_policy import OBSERVED, ResidualPolicy


def policy_of(seed, bound=0.1):
    random = np.random.default_rng(seed)
    shapes = (OBSERVED, 8), (8,), (8, 8), (8,), (8, 6)
    return ResidualPolicy(*(random.normal(size=shape).astype(np.float32) for shape in shapes), np.full(6, bound))
