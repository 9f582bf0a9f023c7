"""Policies of other libraries, such as stable-baselines3, as controllers."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Measured
from softfin.control.references import check_within, controller_cells, reachable_set
from softfin.core.errors import RunError
from softfin.core.operations import NUMPY
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.gaits.reachable import ForceVector
from softfin.task.task import TaskConfig, rest_actions


@runtime_checkable
class PredictPolicy(Protocol):
    """A policy that learnt in softfin's Gymnasium environment, such as a model of
    stable-baselines3 or sb3-contrib.

    The optional attribute `task` is the `TaskConfig` of its environment; `cells` and `reachable`
    are as for a `Controller`.
    """

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[Any, Any]:
        """Return the actions for observations ``(1, observations)`` and the next state, which is
        None before the first action."""
        ...


class PredictState(NamedTuple):
    """State of a `PolicyController`."""

    memory: Any
    """State of the policy; None before the first action."""
    actions: Float[np.ndarray, "numbers"]
    """Past actions, newest first."""
    is_first: bool


class PolicyController:
    """A policy with `predict` as a `Controller`, in the units of the `limits` that it learnt in."""

    kind = "policy"

    def __init__(
        self, policy: PredictPolicy, limits: Limits, task: TaskConfig | None = None
    ) -> None:
        self.policy = policy
        self.limits = limits
        self.task = task or getattr(policy, "task", None) or TaskConfig()
        self.clock = self.task.clock
        self.cells = controller_cells(policy)
        self.reachable = reachable_set(policy)

    def init(self) -> PredictState:
        """Return the state before the first action."""
        actions = np.asarray(rest_actions(self.task, self.limits)).reshape(-1)
        return PredictState(None, actions, True)

    def act(
        self, state: PredictState, measured: Measured, reference: Any
    ) -> tuple[PredictState, Command]:
        """Return the command of the policy's deterministic action; raises RunError if the action is
        not two numbers in [-1, 1]."""
        now = np.array([measured.angle, *reference])
        observed = self.task.observation.observe_scaled(NUMPY, now, state.actions)
        predicted, memory = self.policy.predict(
            observed[None].astype(np.float32),
            state=state.memory,
            episode_start=np.array([state.is_first]),
            deterministic=True,
        )
        action = np.asarray(predicted, float).reshape(-1)
        # Negated, so that NaN is refused.
        if action.shape != (2,) or not (abs(action) <= 1).all():
            raise RunError(
                f"{type(self.policy).__name__}: action {predicted} must be two numbers in [-1, 1]; "
                "clip it or squash it"
            )
        actions = np.concatenate([action, state.actions[:-2]])
        return PredictState(memory, actions, False), action_to_command(self.limits, action)

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the policy has cells and the reference [N] is outside them."""
        if self.cells:
            check_within(self.cells, reference)
