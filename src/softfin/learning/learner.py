"""What a training run needs of an algorithm: it starts lanes and updates them. LSTM-PPO and gradient training are such.

A lane is one policy with its own key and its own box of references; all of it is pure, and `vmap` adds lanes.
"""

from typing import Any, Protocol, TypeAlias, runtime_checkable

import optax
from jaxtyping import Float, PRNGKeyArray

from softfin.core.quantities import AnyArray
from softfin.learning.policy import Policy
from softfin.task.references import References

Metrics: TypeAlias = dict[str, Float[AnyArray, "*lanes"]]
"""Scalars of an update: ``loss``, ``error_x_n``, ``error_y_n`` [N], and what else the algorithm tells."""


@runtime_checkable
class Lane(Protocol):
    """A pytree: everything that one policy's training carries from update to update."""

    @property
    def policy(self) -> Policy:
        """What has been learnt so far."""
        ...


@runtime_checkable
class Learner(Protocol):
    """An algorithm for one task, over a number of updates."""

    def init(self, key: PRNGKeyArray, references: References) -> Lane:
        """A lane with new networks, fins at rest."""
        ...

    def update(self, lane: Any) -> tuple[Any, Metrics]:
        """One update."""
        ...


def clipped_adam(rate: optax.Schedule, longest: float) -> optax.GradientTransformation:
    """Adam on gradients of at most this norm, over all weights as one vector, which compiles sooner than one by one."""
    return optax.flatten(optax.chain(optax.clip_by_global_norm(longest), optax.adam(rate, eps=1e-5)))
