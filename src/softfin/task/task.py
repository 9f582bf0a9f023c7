"""Force tracking as pure functions for any plant (paper Sec. III-C2): for an action, they move the
plant and return a reward and a new state.

    action in [-1, 1]^2 ──> command, held for an action ──> plant ──> angle, forces
    observation = [angle, reference x, reference y, A_t, A_t-1, .. A_t-k]

Actions follow the action clock. The duration of an action is a traced value, so that a compiled
program contains the task only once: all actions have as many rows as the longest action, and
shorter actions ignore the last rows.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from softfin.control.policy import PolicyObservation
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.configuration import Configuration
from softfin.core.operations import jax_operations
from softfin.core.plant import (
    Plant,
    State,
    Ticks,
    hold_action,
    hold_action_with_hidden,
    mean_loads,
    rest_command,
)
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.core.window import sobolev, window_mean
from softfin.task.references import ForceBatch, ForcePoint, References

Action = Float[Array, "2"]
"""(angle, velocity), with the plant's limits normalised to [-1, 1]."""

PastActions = Float[Array, "remembered 2"]
ForceWindow = Float[Array, "window 2"]

MIN_WIDTH_RAD_S = 1e-6
"""Minimum width by which a velocity range is divided [rad/s]."""

FORCE_BLOCKS = 8
"""Number of window blocks whose mean forces the critic observes; they reveal which forces are about
to leave the window."""


class RewardTerms(NamedTuple):
    """Terms of the reward, per axis [N]."""

    error: ForceBatch
    """|F_e|: distance between the mean force over the window and the reference."""
    smoothness: ForceBatch
    """Sobolev term of the window."""
    power: Float[Array, "*batch"] | None = None
    """Mean power delivered to the fin during the action [W]; None if it has no weight."""


class RewardConfig(Configuration):
    """Weights of the reward (paper Sec. III-C2): error of the mean force, and smoothness.

    The paper does not state the weights. A new term needs a field in `RewardTerms` and a weight
    here.
    """

    weight: tuple[NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0)
    """Weights w for x and y."""
    smoothness: tuple[NonNegativeFloat, NonNegativeFloat] = (0.01, 0.01)
    """Weights lambda for x and y. For a full window, 0.01 with `sobolev` = sum is equivalent to
    0.14 with mean."""
    sobolev: Literal["sum", "mean"] = "sum"
    """Form of the Sobolev term: the square root of the sum (as in the paper) or of the mean of
    squared steps."""
    power: NonNegativeFloat = 0.0
    """Weight of the mean power delivered to the fin [N/W]; the plant must provide the torque."""

    def value(self, terms: RewardTerms) -> Float[Array, "*batch"]:
        """Return the reward r = -sum_d w_d (|F_e^d| + lambda_d S_d) - w_P P [N]."""
        weight = jnp.asarray(self.weight)
        smoothness = jnp.asarray(self.smoothness)
        reward = -jnp.sum(weight * (terms.error + smoothness * terms.smoothness), axis=-1)
        return reward if terms.power is None else reward - self.power * terms.power


class TaskConfig(Configuration):
    """The force-tracking task. The default values in newtons suit the paper's fin."""

    past_actions: int = Field(default=3, ge=0)
    """Number k of observed actions before the last one; k = 3 results in observations of size 11.
    The paper does not state k."""
    clock: ActionClock = PAPER_CLOCK
    """Durations of the actions, and the window for the mean force and the Sobolev term."""
    episode_actions: PositiveInt = 90
    """Number of actions until the episode is truncated, a multiple of the clock cycle; 90 actions
    correspond to 30 s, as in the paper."""
    reference_actions: PositiveInt = 90
    """Number of actions until a new reference is drawn."""
    force_scale_n: PositiveFloat = 3.0
    """Scale of observed references [N], so that observations have magnitudes of about 1."""
    reward: RewardConfig = RewardConfig()

    @model_validator(mode="after")
    def _fits_clock(self) -> "TaskConfig":
        cycle = len(self.clock.ticks)
        if self.episode_actions % cycle:
            raise ValueError(
                f"episode_actions = {self.episode_actions}: must be a multiple of {cycle} "
                "(one clock cycle)"
            )
        if self.episode_actions < self.clock.window_actions:
            raise ValueError(
                f"episode_actions = {self.episode_actions}: an episode must not be shorter than "
                f"the window; use at least {self.clock.window_actions}"
            )
        return self

    @property
    def observations(self) -> int:
        """Size of an observation."""
        return self.observation.size

    @property
    def observation(self) -> PolicyObservation:
        """Definition of the observations."""
        return PolicyObservation(
            past_actions=self.past_actions, force_scale_n=self.force_scale_n, clock=self.clock
        )

    def scaled(self, size: float) -> "TaskConfig":
        """Return the task for a fin of a different size, relative to the paper's fin; the
        magnitudes of observations and rewards stay the same."""
        x, y = self.reward.weight
        values = {
            "force_scale_n": self.force_scale_n * size,
            "reward": {"weight": (x / size, y / size), "power": self.reward.power / size},
        }
        return self.merged(values, "size")


class TaskState(NamedTuple):
    """State of one fin and its reference."""

    plant: State
    angle: Float[Array, ""]
    """Angle of the shaft at the last reading [rad]."""
    reference: ForcePoint
    references: References
    """Distribution of references."""
    actions: PastActions
    """Past actions, most recent first."""
    forces: ForceWindow
    """Last force readings [N], newest last; only the last `samples` readings were recorded since
    the reset."""
    samples: Int[Array, ""]
    age: Int[Array, ""]
    """Number of actions since the reset."""
    key: PRNGKeyArray


class Outcome(NamedTuple):
    """Result of one action."""

    reward: Float[Array, ""]
    terms: RewardTerms
    """Terms of the reward."""
    force_error: ForcePoint
    """F_e: mean force over the window minus the reference [N]."""
    forces: Float[Array, "ticks 2"]
    """Forces during the action [N]; rows after its duration are not valid."""


@dataclass(frozen=True)
class ForceTracking:
    """The task on one plant, without batch axes (`jax.vmap` adds them)."""

    plant: Plant
    config: TaskConfig

    def reset(self, key: PRNGKeyArray, references: References) -> TaskState:
        """Return a state with the fin at rest, an empty window and a new reference."""
        plant_key, reference_key, key = jax.random.split(key, 3)
        return TaskState(
            plant=self.plant.init(plant_key),
            angle=jnp.float32(self.plant.limits.rest_angle),
            reference=references.draw(reference_key),
            references=references,
            actions=rest_actions(self.config, self.plant.limits),
            forces=jnp.zeros((self.config.clock.window_ticks, 2)),
            samples=jnp.int32(0),
            age=jnp.int32(0),
            key=key,
        )

    def observe(self, state: TaskState) -> Float[Array, "observations"]:
        """Return the observation (the paper's state)."""
        return observation(self.config, state.angle, state.reference, state.actions)

    def privileged_observation(self, state: TaskState) -> Float[Array, "privileged"]:
        """Return the observation with privileged information: the forces in the window, the
        fraction of the window that is valid, and the clock."""
        scale = self.config.force_scale_n
        # Means per block, scaled so that their mean is the mean over the valid samples; the zeros
        # in a window that is not yet full must not count.
        rows = -(-len(state.forces) // FORCE_BLOCKS)
        # Zeros in front of the oldest forces fill the first block.
        missing = FORCE_BLOCKS * rows - len(state.forces)
        forces = jnp.pad(state.forces, ((missing, 0), (0, 0)))
        window = forces.reshape(FORCE_BLOCKS, rows, 2).sum(axis=1) * FORCE_BLOCKS
        mean = (window / jnp.maximum(state.samples, 1)).reshape(-1) / scale
        full = state.samples / self.config.clock.window_ticks
        cycle = len(self.config.clock.ticks)
        clock = jax.nn.one_hot(state.age % cycle, cycle)
        return jnp.concatenate([self.observe(state), mean, full[None], clock])

    def step(self, state: TaskState, action: Action, ticks: Ticks) -> tuple[TaskState, Outcome]:
        """Hold an action for a number of ticks."""
        reward = self.config.reward
        clock = self.config.clock
        held = (action_to_command(self.plant.limits, action), ticks, clock.max_ticks)
        power = None
        if reward.power:
            plant, (reading, hidden) = hold_action_with_hidden(self.plant, state.plant, *held)
            assert hidden.torque is not None
            (_, power), _ = mean_loads(
                jnp.asarray(hidden.torque), jnp.asarray(reading.velocity), ticks
            )
        else:
            plant, reading = hold_action(self.plant, state.plant, *held)
        # The window moves by the valid ticks of this action only.
        forces = _last(state.forces, jnp.asarray(reading.force), ticks)
        samples = jnp.minimum(state.samples + ticks, clock.window_ticks)
        force_error = window_mean(forces, samples) - state.reference
        smoothness = sobolev(forces, samples, reward.sobolev)
        terms = RewardTerms(jnp.abs(force_error), smoothness, power)
        # Each key in the chain is used only once, so that no two actions or episodes draw the same
        # numbers.
        key, reference_key = jax.random.split(state.key)
        age = state.age + 1
        is_due = age % self.config.reference_actions == 0
        return TaskState(
            plant=plant,
            # The last valid tick is row ticks - 1.
            angle=jnp.asarray(reading.angle)[ticks - 1],
            reference=jnp.where(is_due, state.references.draw(reference_key), state.reference),
            references=state.references,
            actions=remember(state.actions, action),
            forces=forces,
            samples=samples,
            age=age,
            key=key,
        ), Outcome(reward.value(terms), terms, force_error, jnp.asarray(reading.force))

    def truncated(self, state: TaskState) -> Bool[Array, ""]:
        """Return whether the episode is over. It is truncated, not terminated, because the fin
        could continue."""
        return state.age >= self.config.episode_actions


def _last(before: ForceWindow, rows: Float[Array, "rows 2"], ticks: Ticks) -> ForceWindow:
    """Append the first `ticks` rows to a window and drop the same number of old rows."""
    # A traced start with a static length keeps one program for actions of all durations.
    return jax.lax.dynamic_slice_in_dim(jnp.concatenate([before, rows]), ticks, len(before))


def observation(
    config: TaskConfig,
    angle: Float[Array, ""],
    reference: ForcePoint,
    actions: PastActions,
) -> Float[Array, "observations"]:
    """Return [angle, reference x, reference y, A_t, A_t-1, .. A_t-k], in units of 90 degrees and
    `force_scale_n`."""
    now = jnp.concatenate([angle[None], reference])
    flat = actions.reshape(-1)
    return jnp.asarray(config.observation.observe_scaled(jax_operations(), now, flat))


def command_to_action(limits: Limits, command: Command) -> Action:
    """Convert a command to an action by mapping the plant's limits to [-1, 1]^2."""
    angle = (command.angle - limits.angle_min) / (limits.angle_max - limits.angle_min)
    # If there is only one velocity, every action has this velocity.
    width = jnp.maximum(limits.velocity_max - limits.velocity_min, MIN_WIDTH_RAD_S)
    velocity = (command.velocity - limits.velocity_min) / width
    return 2 * jnp.stack([jnp.asarray(angle), jnp.asarray(velocity)]) - 1


def rest_actions(config: TaskConfig, limits: Limits) -> PastActions:
    """Return the past actions of a fin that has long been at rest."""
    return jnp.tile(command_to_action(limits, rest_command(limits)), (config.past_actions + 1, 1))


def remember(actions: PastActions, action: Action) -> PastActions:
    """Prepend an action to the past actions and drop the oldest."""
    return jnp.concatenate([action[None], actions[:-1]])
