"""Force tracking as pure functions over any plant (paper Sec. III-C2): action in, plant moved, reward and state out.

    action in [-1, 1]^2 ──> command, held 33 or 34 ticks ──> plant ──> angle, forces
    observation = [angle, reference x, reference y, A_t, A_t-1, .. A_t-k, and on demand sin, cos of the clock's phase]

Actions follow one another on the 33/33/34 clock. How long one is held is a value in the program, so that a program
holds the task once: all actions have 34 rows, and the last one of a shorter action does not count.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from softfin.control.policy import Observation
from softfin.core.action_clock import MOST_TICKS
from softfin.core.configuration import Configuration
from softfin.core.operations import JAX
from softfin.core.plant import Plant, State, Ticks, hold_action, mean_of, repeat, rest_command
from softfin.core.quantities import Command, Limits, Reading, command_of
from softfin.core.window import window_error, window_mean
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.task.references import References
from softfin.task.reward import SMOOTHNESS, reward

Action = Float[Array, "2"]
"""(angle, velocity) normalised to [-1, 1], the plant's limits."""

FORCE_BLOCKS = 8
"""Parts of the window whose mean forces the critic sees, so that it knows which forces are about to leave it."""


class RewardConfig(Configuration):
    """Weights of the reward; the paper names them and gives no values."""

    weight: tuple[NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0)
    """w of x and y."""
    smoothness: tuple[NonNegativeFloat, NonNegativeFloat] = (0.01, 0.01)
    """lambda of x and y; for a full window 0.01 in the form `sum` weighs as much as 0.14 in the form `mean`."""
    sobolev: Literal["sum", "mean"] = "sum"
    """Form of the Sobolev term: the paper's sum of squared steps or the published code's mean."""
    target: Literal["now", "window"] = "now"
    """What the window's mean force should be: the reference of this moment, as in the paper, or the mean of what was
    asked for over the window, which does not reward making up for what was asked before."""
    disagreement: NonNegativeFloat = 0.0
    """Weight of the deviation between the members of an ensemble, in their mean force while the action is held."""

    def value(
        self,
        error: Float[Array, "*batch 2"],
        smoothness: Float[Array, "*batch 2"],
        disagreement: Float[Array, "*batch 2"],
    ) -> Float[Array, "*batch"]:
        """The reward [N] with these weights, of force errors, Sobolev terms and disagreements [N]."""
        weights = jnp.asarray(self.weight), jnp.asarray(self.smoothness), self.disagreement
        return reward(error, smoothness, disagreement, *weights)


class SensingConfig(Configuration):
    """What stands between the shaft's angle and the policy; a simulator has neither."""

    noise_rad: NonNegativeFloat = 0.0
    """Standard deviation of the angle's noise [rad]."""
    delay_ticks: int = Field(default=0, ge=0, le=30)
    """Age of the angle when it is acted on [10 ms]."""


class TaskConfig(Configuration):
    """The task."""

    past_actions: int = Field(default=3, ge=0)
    """k: actions before the last one that are observed; 3 makes 11 observations, so the paper's 592,325 weights."""
    window_samples: int = Field(default=200, ge=8, multiple_of=8)
    """Evaluation window of the mean force and the Sobolev term [samples at 100 Hz]."""
    episode_actions: int = Field(default=90, ge=3, multiple_of=3)
    """Actions until the fin starts again from rest, whole cycles of three; 90 are the paper's 30 s."""
    reference_actions: PositiveInt = 90
    """Actions until another reference is drawn."""
    ramps: float = Field(default=0.0, ge=0, le=1)
    """Share of the drawn references that are gone to in a straight line, until the next is due; others are steps."""
    force_scale_n: PositiveFloat = 3.0
    """References are observed in this unit [N], so that they are of about unit size."""
    phase: bool = False
    """Whether the phase of the six actions that fill the window is observed, as a sine and a cosine; the paper's state
    has none, and a policy then has to find a beat of its own."""
    reward: RewardConfig = RewardConfig()
    sensing: SensingConfig = SensingConfig()

    @property
    def observations(self) -> int:
        """How many numbers are observed."""
        return Observation(past_actions=self.past_actions, phase=self.phase).size


class TaskState(NamedTuple):
    """One fin with a reference."""

    plant: State
    angle: Float[Array, ""]
    """Of the shaft, last read [rad]."""
    reference: Float[Array, "2"]
    drift: Float[Array, "2"]
    """Of the reference, an action [N]."""
    references: References
    """Where references are drawn from."""
    actions: Float[Array, "remembered 2"]
    """The last one first."""
    forces: Float[Array, "window 2"]
    """The newest last; only the last `samples` of them were made since the reset."""
    asked: Float[Array, "window 2"]
    """The reference of each of these [N]."""
    samples: Int[Array, ""]
    age: Int[Array, ""]
    """Actions since the reset."""
    key: PRNGKeyArray


class Outcome(NamedTuple):
    """What one action led to."""

    reward: Float[Array, ""]
    error: Float[Array, "2"]
    """|F_e| of the window [N]."""
    smoothness: Float[Array, "2"]
    """Sobolev term of the window [N]."""
    forces: Float[Array, "ticks 2"]
    """While the action was held [N]; the last of the 34 rows counts where it was held as long."""
    disagreement: Float[Array, "2"]
    """Standard deviation of the members' mean forces meanwhile [N]; 0 of a plant that is no ensemble or not asked."""


@dataclass(frozen=True)
class ForceTracking:
    """The task on one plant; no batch axes (`jax.vmap` adds them)."""

    plant: Plant
    config: TaskConfig

    def reset(self, key: PRNGKeyArray, references: References) -> TaskState:
        """The fin at rest, no force remembered, a reference drawn."""
        plant_key, reference_key, key = jax.random.split(key, 3)
        return TaskState(
            plant=self.plant.init(plant_key),
            angle=jnp.float32(0),
            reference=references.draw(reference_key),
            drift=jnp.zeros(2),
            references=references,
            actions=rest_actions(self.config, self.plant.limits),
            forces=jnp.zeros((self.config.window_samples, 2)),
            asked=jnp.zeros((self.config.window_samples, 2)),
            samples=jnp.int32(0),
            age=jnp.int32(0),
            key=key,
        )

    def observe(self, state: TaskState) -> Float[Array, "observations"]:
        """The paper's state."""
        return observation(self.config, state.angle, state.reference, state.actions, state.age)

    def inspect(self, state: TaskState) -> Float[Array, "seen"]:
        """The observation, and what only a simulator knows: the window's forces, how many count, the clock."""
        scale = self.config.force_scale_n
        window = state.forces.reshape(FORCE_BLOCKS, -1, 2).sum(axis=1) * FORCE_BLOCKS
        mean = (window / jnp.maximum(state.samples, 1)).reshape(-1) / scale
        full = state.samples / self.config.window_samples
        clock = jax.nn.one_hot(state.age % 3, 3)
        return jnp.concatenate([self.observe(state), mean, full[None], clock])

    def step(self, state: TaskState, action: Action, ticks: Ticks) -> tuple[TaskState, Outcome]:
        """Hold an action for 33 or 34 ticks."""
        plant, reading, disagreement = self._advance(state.plant, command_of(self.plant.limits, action), ticks)
        asked = _last(state.asked, jnp.tile(state.reference, (MOST_TICKS, 1)), ticks)
        forces = _last(state.forces, jnp.asarray(reading.force), ticks)
        samples = jnp.minimum(state.samples + ticks, self.config.window_samples)
        age = state.age + 1
        target = state.reference if self.config.reward.target == "now" else window_mean(asked, samples)
        outcome = self._judge(forces, samples, target, jnp.asarray(reading.force), disagreement)
        sensing = self.config.sensing
        # A chain: each key is used once, so neither another action nor the next episode draws the same numbers.
        key, noise_key, reference_key = jax.random.split(state.key, 3)
        noise = sensing.noise_rad * jax.random.normal(noise_key)
        reference, drift = self._moved(state, reference_key, age % self.config.reference_actions == 0)
        return TaskState(
            plant=plant,
            angle=jnp.asarray(reading.angle)[ticks - 1 - sensing.delay_ticks] + noise,
            reference=reference,
            drift=drift,
            references=state.references,
            actions=remember(state.actions, action),
            forces=forces,
            asked=asked,
            samples=samples,
            age=age,
            key=key,
        ), outcome

    def _moved(
        self, state: TaskState, key: PRNGKeyArray, due: Bool[Array, ""]
    ) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """The reference of the next action and its drift; where another is `due` it is drawn, to be gone to."""
        # One draw for all: each takes a quarter of a second to compile.
        chance = jax.random.uniform(key, (3,))
        drawn, ramp = state.references.at(chance[:2]), chance[2] < self.config.ramps
        towards = (drawn - state.reference) / self.config.reference_actions
        drift = jnp.where(due, jnp.where(ramp, towards, 0), state.drift)
        return jnp.where(due & ~ramp, drawn, state.reference + drift), drift

    def finished(self, state: TaskState) -> Bool[Array, ""]:
        """Whether the episode is over: cut, not ended, since the fin could beat on."""
        return state.age >= self.config.episode_actions

    def _advance(self, state: State, command: Command, ticks: Ticks) -> tuple[State, Reading, Float[Array, "2"]]:
        """The plant, and how much the members of an ensemble disagree, where that is asked for."""
        plant = self.plant
        if self.config.reward.disagreement == 0 or not isinstance(plant, StreamingSurrogate):
            return *hold_action(plant, state, command, ticks), jnp.zeros(2)

        def tick(state: State) -> tuple[State, Reading]:
            state, each = plant.advance_members(state, command, 1)
            return state, jax.tree.map(lambda x: x[:, 0], each)

        state, each = repeat(tick, state, ticks)
        force = mean_of(jnp.asarray(each.force), ticks)
        return state, jax.tree.map(lambda x: x.mean(axis=1), each), force.std(axis=0)

    def _judge(
        self,
        forces: Float[Array, "window 2"],
        samples: Int[Array, ""],
        reference: Float[Array, "2"],
        fresh: Float[Array, "ticks 2"],
        disagreement: Float[Array, "2"],
    ) -> Outcome:
        config = self.config.reward
        error = window_error(forces, samples, reference)
        smoothness = SMOOTHNESS[config.sobolev](forces, samples)
        return Outcome(config.value(error, smoothness, disagreement), error, smoothness, fresh, disagreement)


def _last(before: Float[Array, "window 2"], rows: Float[Array, "34 2"], ticks: Ticks) -> Float[Array, "window 2"]:
    """The window after so many more rows."""
    return jax.lax.dynamic_slice_in_dim(jnp.concatenate([before, rows]), ticks, len(before))


def observation(
    config: TaskConfig,
    angle: Float[Array, ""],
    reference: Float[Array, "2"],
    actions: Float[Array, "remembered 2"],
    age: Int[Array, ""],
) -> Float[Array, "observations"]:
    """[angle, reference x, reference y, A_t, A_t-1, .. A_t-k], in units of 90 degrees and `force_scale_n`.

    With `config.phase`, sine and cosine of the phase follow, which is 0 at every sixth action, `age` counted from 0.
    """
    part = Observation(past_actions=config.past_actions, phase=config.phase, force_scale_n=config.force_scale_n)
    now = jnp.concatenate([angle[None], reference])
    return jnp.asarray(part.observe(JAX, now, actions.reshape(-1), age) / part.units())


def action_of(limits: Limits, command: Command) -> Action:
    """The plant's limits onto [-1, 1]^2."""
    angle = (command.angle - limits.angle_min) / (limits.angle_max - limits.angle_min)
    velocity = (command.velocity - limits.velocity_min) / (limits.velocity_max - limits.velocity_min)
    return 2 * jnp.stack([jnp.asarray(angle), jnp.asarray(velocity)]) - 1


def rest_actions(config: TaskConfig, limits: Limits) -> Float[Array, "remembered 2"]:
    """The memory of a fin that has long been told to stay where it is."""
    return jnp.tile(action_of(limits, rest_command(limits)), (config.past_actions + 1, 1))


def remember(actions: Float[Array, "remembered 2"], action: Action) -> Float[Array, "remembered 2"]:
    """A new action in front, the oldest forgotten."""
    return jnp.concatenate([action[None], actions[:-1]])
