"""Force tracking as pure functions over any plant (paper Sec. III-C2): an action goes in, the plant
moves, and a reward and a state come out.

    action in [-1, 1]^2 ──> command, held for an action ──> plant ──> angle, forces
    observation = [angle, reference x, reference y, A_t, A_t-1, .. A_t-k,
                   and optionally sin, cos of the clock's phase]

Actions follow each other on the action clock. The duration of an action is a traced value, so that
a compiled program contains the task only once: all actions have as many rows as the longest, and a
shorter action ignores the last ones.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import (
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from softfin.control.policy import PolicyObservation
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.configuration import Configuration
from softfin.core.operations import jax_operations
from softfin.core.plant import Plant, State, Ticks, hold_action, rest_command
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.core.window import sobolev, window_error, window_mean
from softfin.task.references import ForceBatch, ForcePoint, References

Action = Float[Array, "2"]
"""(angle, velocity), with the plant's limits normalised to [-1, 1]."""

PastActions = Float[Array, "remembered 2"]
ForceWindow = Float[Array, "window 2"]

FORCE_BLOCKS = 8
"""Number of blocks of the window whose mean forces the critic observes; they reveal which forces
are about to leave the window."""


class RewardTerms(NamedTuple):
    """Terms of the reward, per axis [N]."""

    error: ForceBatch
    """|F_e|: distance of the window's mean force from its target."""
    smoothness: ForceBatch
    """Sobolev term of the window."""


class RewardConfig(Configuration):
    """Weights of the reward (paper Sec. III-C2): error of the mean force, and smoothness.

    The paper does not state their values. A new term needs a field in `RewardTerms` and a weight
    here.
    """

    weight: tuple[NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0)
    """Weights w for x and y."""
    smoothness: tuple[NonNegativeFloat, NonNegativeFloat] = (0.01, 0.01)
    """Weights lambda for x and y. For a full window, 0.01 with `sobolev` = sum is equivalent to
    0.14 with mean."""
    sobolev: Literal["sum", "mean"] = "sum"
    """Form of the Sobolev term: the square root of the sum of squared steps, as in the paper, or of
    their mean."""
    target: Literal["now", "window"] = "now"
    """Target of the window's mean force: the current reference, as in the paper, or the mean of the
    references over the window, which does not reward compensation for earlier ones."""

    def value(self, terms: RewardTerms) -> Float[Array, "*batch"]:
        """Return the reward r = -sum_d w_d (|F_e^d| + lambda_d S_d) [N]."""
        weight = jnp.asarray(self.weight)
        smoothness = jnp.asarray(self.smoothness)
        return -jnp.sum(weight * (terms.error + smoothness * terms.smoothness), axis=-1)


class SensingConfig(Configuration):
    """Noise and delay of the measured angle, which a simulator lacks."""

    noise_rad: NonNegativeFloat = 0.0
    """Standard deviation of the angle's noise [rad]."""
    delay_ticks: NonNegativeInt = 0
    """Age of the angle when the policy acts on it [10 ms]; shorter than an action."""


class TaskConfig(Configuration):
    """The force-tracking task."""

    past_actions: int = Field(default=3, ge=0)
    """Number k of observed actions before the last one; 3 results in 11 observations. The paper
    does not state k."""
    clock: ActionClock = PAPER_CLOCK
    """Durations of the actions, and the window."""
    window_samples: PositiveInt | None = None
    """Evaluation window of the mean force and the Sobolev term [samples at 100 Hz]; null: the
    window of the clock."""
    episode_actions: PositiveInt = 90
    """Number of actions until the episode is truncated, a whole number of cycles of the clock; 90
    correspond to the paper's 30 s."""
    reference_actions: PositiveInt = 90
    """Number of actions until a new reference is drawn."""
    ramps: float = Field(default=0.0, ge=0, le=1)
    """Fraction of references that are ramps, which end when the next reference is due; the others
    are steps."""
    force_scale_n: PositiveFloat = 3.0
    """Scale of observed references [N], chosen so that observations have magnitudes of about 1."""
    phase: bool = False
    """Whether the phase of the actions in the window is observed, as a sine and a cosine. Without
    it, as in the paper's state, a policy must find its own rhythm."""
    reward: RewardConfig = RewardConfig()
    sensing: SensingConfig = SensingConfig()

    @model_validator(mode="after")
    def _fits_clock(self) -> "TaskConfig":
        cycle = len(self.clock.ticks)
        if self.episode_actions % cycle:
            raise ValueError(
                f"episode_actions = {self.episode_actions}: must be a whole number of cycles of "
                f"the clock; use a multiple of {cycle}"
            )
        if self.sensing.delay_ticks >= min(self.clock.ticks):
            raise ValueError(
                f"sensing.delay_ticks = {self.sensing.delay_ticks}: must be shorter than an action "
                f"of {min(self.clock.ticks)} ticks; use a smaller delay"
            )
        return self

    @property
    def window_ticks(self) -> int:
        """Number of samples in the window."""
        return self.window_samples or self.clock.window_ticks

    @property
    def observations(self) -> int:
        """Size of an observation."""
        return PolicyObservation(past_actions=self.past_actions, phase=self.phase).size


class TaskState(NamedTuple):
    """One fin with a reference."""

    plant: State
    angle: Float[Array, ""]
    """Angle of the shaft at the last reading [rad]."""
    reference: ForcePoint
    drift: ForcePoint
    """Change of the reference with each action [N]."""
    references: References
    """Distribution of references."""
    actions: PastActions
    """Past actions, most recent first."""
    forces: ForceWindow
    """Last force readings [N], newest last; only the last `samples` of them were recorded since the
    reset."""
    past_references: ForceWindow
    """Reference at each of these readings [N]."""
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
    """F_e: the window's mean force minus its target [N]."""
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
            drift=jnp.zeros(2),
            references=references,
            actions=rest_actions(self.config, self.plant.limits),
            forces=jnp.zeros((self.config.window_ticks, 2)),
            past_references=jnp.zeros((self.config.window_ticks, 2)),
            samples=jnp.int32(0),
            age=jnp.int32(0),
            key=key,
        )

    def observe(self, state: TaskState) -> Float[Array, "observations"]:
        """Return the observation (the paper's state)."""
        return observation(self.config, state.angle, state.reference, state.actions, state.age)

    def privileged_observation(self, state: TaskState) -> Float[Array, "privileged"]:
        """Return the observation with privileged information: the window's forces, the fraction of
        it that is valid, and the clock."""
        scale = self.config.force_scale_n
        # Means per block, scaled so that their mean is the mean over the valid samples: in a window
        # that is not yet full, the zeros must not count.
        rows = -(-len(state.forces) // FORCE_BLOCKS)
        # Zeros in front of the oldest forces fill the first block.
        missing = FORCE_BLOCKS * rows - len(state.forces)
        forces = jnp.pad(state.forces, ((missing, 0), (0, 0)))
        window = forces.reshape(FORCE_BLOCKS, rows, 2).sum(axis=1) * FORCE_BLOCKS
        mean = (window / jnp.maximum(state.samples, 1)).reshape(-1) / scale
        full = state.samples / self.config.window_ticks
        cycle = len(self.config.clock.ticks)
        clock = jax.nn.one_hot(state.age % cycle, cycle)
        return jnp.concatenate([self.observe(state), mean, full[None], clock])

    def step(self, state: TaskState, action: Action, ticks: Ticks) -> tuple[TaskState, Outcome]:
        """Hold an action for `ticks` ticks."""
        config = self.config.reward
        sensing = self.config.sensing
        rows = self.config.clock.max_ticks
        plant, reading = hold_action(
            self.plant, state.plant, action_to_command(self.plant.limits, action), ticks, rows
        )
        past_references = _last(state.past_references, jnp.tile(state.reference, (rows, 1)), ticks)
        # The window moves by the valid ticks of this action only.
        forces = _last(state.forces, jnp.asarray(reading.force), ticks)
        samples = jnp.minimum(state.samples + ticks, self.config.window_ticks)
        target = (
            state.reference if config.target == "now" else window_mean(past_references, samples)
        )
        force_error = window_error(forces, samples, target)
        terms = RewardTerms(jnp.abs(force_error), sobolev(forces, samples, config.sobolev))
        # A chain of keys: each is used once, so that no other action or episode draws the same
        # numbers.
        key, noise_key, reference_key = jax.random.split(state.key, 3)
        noise = sensing.noise_rad * jax.random.normal(noise_key)
        age = state.age + 1
        # The next reference, if one is due: a step or a ramp. A single draw, because each takes a
        # quarter of a second to compile.
        is_due = age % self.config.reference_actions == 0
        chance = jax.random.uniform(reference_key, (3,))
        sampled = state.references.at(chance[:2])
        ramp = chance[2] < self.config.ramps
        towards = (sampled - state.reference) / self.config.reference_actions
        drift = jnp.where(is_due, jnp.where(ramp, towards, 0), state.drift)
        return TaskState(
            plant=plant,
            # The last valid tick is row ticks - 1; a delay looks further back within the action.
            angle=jnp.asarray(reading.angle)[ticks - 1 - sensing.delay_ticks] + noise,
            reference=jnp.where(is_due & ~ramp, sampled, state.reference + drift),
            drift=drift,
            references=state.references,
            actions=remember(state.actions, action),
            forces=forces,
            past_references=past_references,
            samples=samples,
            age=age,
            key=key,
        ), Outcome(config.value(terms), terms, force_error, jnp.asarray(reading.force))

    def shifted(
        self, observation: Float[Array, "*batch n"], shift: ForceBatch
    ) -> Float[Array, "*batch n"]:
        """Return observations, privileged or not, as if the reference were shifted by `shift`
        [N]."""
        # Both kinds of observations start with angle, reference x, reference y.
        return observation.at[..., 1:3].add(shift / self.config.force_scale_n)

    def truncated(self, state: TaskState) -> Bool[Array, ""]:
        """Whether the episode is over: truncated, not terminated, because the fin could
        continue."""
        return state.age >= self.config.episode_actions


def _last(before: ForceWindow, rows: Float[Array, "rows 2"], ticks: Ticks) -> ForceWindow:
    """Append the first `ticks` rows to a window and drop as many old ones."""
    # A traced start with a static length keeps one program for actions of all durations.
    return jax.lax.dynamic_slice_in_dim(jnp.concatenate([before, rows]), ticks, len(before))


def observation(
    config: TaskConfig,
    angle: Float[Array, ""],
    reference: ForcePoint,
    actions: PastActions,
    age: Int[Array, ""],
) -> Float[Array, "observations"]:
    """Return [angle, reference x, reference y, A_t, A_t-1, .. A_t-k], in units of 90 degrees and
    `force_scale_n`.

    With `config.phase`, the sine and cosine of the phase follow; the phase is 0 at the first action
    of each window, with `age` counted from 0.
    """
    part = PolicyObservation(
        past_actions=config.past_actions,
        phase=config.phase,
        force_scale_n=config.force_scale_n,
        clock=config.clock,
    )
    now = jnp.concatenate([angle[None], reference])
    return jnp.asarray(part.observe(jax_operations(), now, actions.reshape(-1), age) / part.units())


def command_to_action(limits: Limits, command: Command) -> Action:
    """Return the action of a command: map the plant's limits to [-1, 1]^2."""
    angle = (command.angle - limits.angle_min) / (limits.angle_max - limits.angle_min)
    velocity = (command.velocity - limits.velocity_min) / (
        limits.velocity_max - limits.velocity_min
    )
    return 2 * jnp.stack([jnp.asarray(angle), jnp.asarray(velocity)]) - 1


def rest_actions(config: TaskConfig, limits: Limits) -> PastActions:
    """Return the past actions of a fin that has long been at rest."""
    return jnp.tile(command_to_action(limits, rest_command(limits)), (config.past_actions + 1, 1))


def remember(actions: PastActions, action: Action) -> PastActions:
    """Prepend an action to the past actions and drop the oldest."""
    return jnp.concatenate([action[None], actions[:-1]])
