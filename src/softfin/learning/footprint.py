"""Memory that policies take: their weights, and what training holds of them besides (paper Sec. IV: 7.2 MB a model).

What only training needs is left out: the critic of LSTM-PPO with its optimiser, and the rollouts.
"""

import math
from typing import NamedTuple

import jax

from softfin.learning.policy import Policy

OPTIMISER_COPIES = 2
"""Adam keeps two numbers for each weight; the paper's 7.2 MB are weights and these."""


class Footprint(NamedTuple):
    """Of the policies of one controller."""

    policies: int
    weights: int
    """Of each policy."""
    weights_bytes: int
    """Of each policy: what a robot holds for each cell."""
    optimiser_bytes: int
    """Of each policy, while it is trained."""

    @property
    def total_bytes(self) -> int:
        """Of all policies, weights and optimiser."""
        return self.policies * (self.weights_bytes + self.optimiser_bytes)

    @classmethod
    def of(cls, description: dict[str, int]) -> "Footprint":
        """From what `described` gave."""
        return cls(*(description[name] for name in cls._fields))

    def described(self) -> dict[str, int]:
        """For JSON."""
        return {**self._asdict(), "total_weights_bytes": self.policies * self.weights_bytes,
                "total_bytes": self.total_bytes}  # fmt: skip

    def __str__(self) -> str:
        each, kept = (f"{value / 1e3:.0f} kB" for value in (self.weights_bytes, self.policies * self.weights_bytes))
        trained = f"{self.total_bytes / 1e3:.0f} kB"
        count = f"{self.policies} policies" if self.policies > 1 else "1 policy"
        return f"memory: {count} of {self.weights:,} weights, {each} each, {kept} in all; {trained} while training"


def memory_of(policy: Policy) -> Footprint:
    """Of one policy, or of policies stacked along leading axes."""
    count = math.prod(policy.log_deviation.shape[:-1])
    leaves = jax.tree.leaves(policy)
    weights, size = sum(leaf.size for leaf in leaves) // count, sum(leaf.nbytes for leaf in leaves) // count
    return Footprint(count, weights, size, OPTIMISER_COPIES * size)
