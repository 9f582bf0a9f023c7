"""What a training run needs of an algorithm: it starts agents and updates them. LSTM-PPO and gradient training do.

An agent is one policy with its own key, environments and box of references; all of it is pure, and `vmap` adds agents.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.quantities import AnyArray
from softfin.learning.policy import ActorCritic, Policy
from softfin.learning.rollout import EnvState
from softfin.task.references import References

Metrics: TypeAlias = dict[str, Float[AnyArray, "*agents"]]
"""Scalars of an update: ``loss``, ``error_x_n``, ``error_y_n`` [N], ``gradient_norm``, and others of the algorithm."""


class AgentState(NamedTuple):
    """Everything that the training of one policy carries from update to update."""

    networks: ActorCritic | None
    """Networks that act and learn; None where the policy itself does."""
    policy: Policy
    """The policy that is evaluated and kept."""
    optimiser: Any
    env_state: EnvState
    key: PRNGKeyArray
    num_updates: Int[Array, ""]
    """Updates done so far."""


@runtime_checkable
class Learner(Protocol):
    """An algorithm for one task, over a number of updates."""

    def init(self, key: PRNGKeyArray, references: References) -> AgentState:
        """An agent with new networks, its fins at rest."""
        ...

    def update(self, agent: AgentState) -> tuple[AgentState, Metrics]:
        """Collect experience and learn from it, once."""
        ...


def clipped_adam(rate: optax.Schedule, max_norm: float) -> optax.GradientTransformation:
    """Adam on gradients of at most this norm, over all weights as one vector, which compiles sooner than one by one."""
    return optax.flatten(optax.chain(optax.clip_by_global_norm(max_norm), optax.adam(rate, eps=1e-5)))
