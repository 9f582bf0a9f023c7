"""Training of a residual policy by gradients through body and fins, with a critic at the horizon's end.

Errors are differentiated through the averaged robot over some seconds; what comes after is the critic's, since a
position has a memory of tens of seconds (short-horizon actor-critic: Xu et al. 2022).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.configuration import Configuration
from softfin.core.errors import RunError
from softfin.core.quantities import AnyArray
from softfin.core.randomness import generator_of, key_of
from softfin.learning.layers import weights
from softfin.learning.rollout import clipped_adam
from softfin.robot.allocation import Allocator
from softfin.robot.averaged import AFTER, BEFORE, STEP_S, STEPS, AveragedRobot, AveragedState
from softfin.robot.description import RobotConfig
from softfin.robot.dynamics import BodyState
from softfin.robot.fin_driver import FinGaits
from softfin.robot.noise import NoiseConfig
from softfin.robot.paths import Path, PathPoint, error_of, hold, lemniscate, lissajous, twist_of
from softfin.robot.residual_policy import ERROR, LATER_S, OBSERVED, RATE, Perceptron, ResidualPolicy, observed
from softfin.robot.rotation import matrix


class RobotTrainConfig(Configuration):
    """Settings of the training."""

    num_envs: PositiveInt = 64
    """Robots side by side."""
    num_steps: PositiveInt = 24
    """Actions between updates, a divisor of 240; gradients reach back as far."""
    num_updates: PositiveInt = 800
    """Updates of policy and critic."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate of Adam, at its greatest; it falls to a hundredth as a cosine."""
    discount: float = Field(0.97, gt=0, lt=1)
    """Weight of an action's cost against that of the action before [-]: 0.97 forgets within 11 s."""
    hidden: PositiveInt = 64
    """Units of each hidden layer."""
    part_of_reach: float = Field(0.1, gt=0, le=1)
    """Greatest wrench of the policy, as a part of the reach along each axis."""
    position_m: PositiveFloat = 0.01
    """Error of position that counts as much as one of attitude of `attitude_rad` [m]."""
    attitude_rad: PositiveFloat = 0.03
    """Error of attitude [rad]."""
    current_m_s: float = Field(0.06, ge=0)
    """Fastest current [m/s]."""
    push_n_s: float = Field(1.2, ge=0)
    """Greatest push [N s]; one in 60 s."""
    speeds_m_s: tuple[PositiveFloat, PositiveFloat] = (0.05, 0.11)
    """Mean speeds along paths [m/s]."""
    noise: NoiseConfig = NoiseConfig()
    """Noise of the estimate of the robot's state."""
    seed: int = Field(0, ge=0)
    """Seed of networks, paths and disturbances."""

    @model_validator(mode="after")
    def _divides(self) -> "RobotTrainConfig":
        if EPISODE_ACTIONS % self.num_steps:
            raise ValueError(f"num_steps = {self.num_steps}: must divide {EPISODE_ACTIONS}, the actions of an episode")
        return self


PATHS, PATH_S = 24, 150.0
"""Paths, a third of each kind, and their length [s]."""

EPISODE_ACTIONS = 240
"""Actions after which a robot begins anew."""

CURRENT_M_S = 0.05
"""Usual size of a current [m/s]."""

PUSHED = 1 / (60 * ACTION_RATE_HZ)
"""Probability of a push in an action."""


class Robots(NamedTuple):
    """A robot on its path; training has a batch of them."""

    state: AveragedState
    path: Int[Array, ""]
    step: Int[Array, ""]
    """Steps since the path's beginning."""
    left: Int[Array, ""]
    """Actions until it begins anew."""


class Agent(NamedTuple):
    """Everything that training carries from update to update."""

    policy: ResidualPolicy
    critic: Perceptron
    slow: Perceptron
    """The critic's moving average, which its targets are made with."""
    optimiser: Any
    critic_optimiser: Any
    robots: Robots
    key: PRNGKeyArray


class Trainer:
    """Trains a policy for one robot."""

    def __init__(self, robot: RobotConfig, gaits: Sequence[FinGaits], config: RobotTrainConfig) -> None:
        self.config, self.model = config, AveragedRobot(robot, gaits, config.noise)
        self.paths = _table(config)
        reach = Allocator(robot.matrix(), np.array([each.reach for each in gaits]))
        along = np.array([reach.reach_along(axis) for axis in range(6)])
        self.bound = config.part_of_reach * along / self.model.dynamics.inertia.diagonal()
        self.optimiser, self.critic_optimiser = (
            clipped_adam(optax.cosine_decay_schedule(config.learning_rate, steps, 0.01), 1.0)
            for steps in (config.num_updates, CRITIC_STEPS * config.num_updates)
        )
        self.update = jax.jit(self._update)

    def init(self) -> Agent:
        """Return a policy that adds nothing, and robots at rest near their paths."""
        keys, hidden = jax.random.split(key_of(self.config.seed, "robot/train"), 7), self.config.hidden

        def network(first: PRNGKeyArray, second: PRNGKeyArray, inputs: int, last: Array) -> Perceptron:
            return Perceptron(weights(first, (inputs, hidden)), jnp.zeros(hidden), weights(second, (hidden, hidden)),
                              jnp.zeros(hidden), last)  # fmt: skip

        policy = ResidualPolicy(network(keys[0], keys[1], OBSERVED, jnp.zeros((hidden, 6))),
                                jnp.asarray(self.bound, jnp.float32))  # fmt: skip
        critic = network(keys[2], keys[3], OBSERVED + 15, weights(keys[4], (hidden, 1)))
        robots = jax.vmap(self._begin)(jax.random.split(keys[5], self.config.num_envs))
        optimisers = self.optimiser.init(policy), self.critic_optimiser.init(critic)
        return Agent(policy, critic, critic, *optimisers, robots, keys[6])

    def _begin(self, key: PRNGKeyArray) -> Robots:
        keys = jax.random.split(key, 7)
        path = jax.random.randint(keys[0], (), 0, PATHS)
        step = jax.random.randint(keys[1], (), BEFORE, self._last_step)
        left = jax.random.randint(keys[2], (), EPISODE_ACTIONS // 3, EPISODE_ACTIONS)
        target = PathPoint(*(part[path, step] for part in self.paths))
        twist = twist_of(target) + jax.random.normal(keys[3], (6,)) * jnp.array([0.01] * 3 + [0.03] * 3)
        body = BodyState(target.position + 0.03 * jax.random.normal(keys[4], (3,)), target.attitude, twist)
        angle, speed = jax.random.uniform(keys[5], (2,)) * jnp.array([2 * jnp.pi, self.config.current_m_s])
        # On a path the fins have less to spare.
        speed = jnp.where(path % 3 == 0, speed, speed / 3)
        current = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
        return Robots(self.model.init(keys[6], body, current, self._window(path, step)), path, step, left)

    @property
    def _last_step(self) -> int:
        return int(PATH_S / STEP_S) - AFTER - EPISODE_ACTIONS * STEPS

    def _window(self, path: Int[Array, ""], step: Int[Array, ""]) -> PathPoint:
        return PathPoint(*(jax.lax.dynamic_slice_in_dim(part[path], step - BEFORE, BEFORE + AFTER + 1)
                           for part in self.paths))  # fmt: skip

    def act(
        self, policy: ResidualPolicy | None, robot: Robots, key: PRNGKeyArray
    ) -> tuple[Robots, Float[AnyArray, "steps 6"]]:
        """Let one robot take one action; a push may come from any side."""
        keys = jax.random.split(key, 3)
        angle, size, chance = jax.random.uniform(keys[0], (3,))
        force = jnp.where(chance < PUSHED, size * self.config.push_n_s * ACTION_RATE_HZ, 0.0)
        push = force * jnp.concatenate([jnp.stack([jnp.cos(2 * jnp.pi * angle), jnp.sin(2 * jnp.pi * angle)]),
                                        jnp.zeros(4)])  # fmt: skip
        window = self._window(robot.path, robot.step)
        state, errors = self.model.act(robot.state, policy, window, push, keys[1])
        return robot._replace(state=state, step=robot.step + STEPS, left=robot.left - 1), errors

    def cost(self, errors: Float[AnyArray, "steps 6"]) -> Float[Array, ""]:
        """Return the cost of an action: quadratic in small errors, and slow to grow in great ones, as of a push."""
        scale = jnp.repeat(jnp.array([self.config.position_m, self.config.attitude_rad]), 3)
        return jnp.log(1 + ((errors / scale) ** 2).sum(axis=1).mean())

    def _value(self, critic: Perceptron, robot: Robots) -> Float[Array, ""]:
        """Return the discounted cost to come, by the critic; it sees what the policy sees, and the truth."""
        state, path = robot.state, self._window(robot.path, robot.step)
        points = [PathPoint(*(part[BEFORE + round(s / STEP_S)] for part in path)) for s in (0.0, *LATER_S)]
        target, body = points[0], state.body
        seen = observed(state.estimate, state.accelerations, points, self.bound)
        truth = [error_of(target, body.position, body.attitude) / ERROR, (body.twist - twist_of(target)) / RATE,
                 state.current @ matrix(target.attitude) / CURRENT_M_S]  # fmt: skip
        return jax.nn.softplus(critic(jnp.clip(jnp.concatenate([seen, *truth]), -10, 10))[0])

    def _update(self, agent: Agent) -> tuple[Agent, dict[str, Array]]:
        config, key = self.config, agent.key
        key, rolling, beginning = jax.random.split(key, 3)
        keys = jax.random.split(rolling, (config.num_steps, config.num_envs))

        def loss(policy: ResidualPolicy) -> tuple[Array, Any]:
            def act(robots: Robots, keys: Array) -> tuple[Robots, Any]:
                after, errors = jax.vmap(partial(self.act, policy))(robots, keys)
                return after, (jax.vmap(self.cost)(errors), jax.lax.stop_gradient((after, errors)))

            robots, (costs, happened) = jax.lax.scan(act, agent.robots, keys)
            ahead = jax.vmap(partial(self._value, agent.slow))(robots)
            discounts = config.discount ** jnp.arange(config.num_steps)
            whole = (discounts[:, None] * costs).sum(axis=0) + config.discount**config.num_steps * ahead
            return whole.mean() / config.num_steps, (robots, costs, happened)

        gradient, (robots, costs, (afters, errors)) = jax.grad(loss, has_aux=True)(agent.policy)
        # The bound is a constant.
        gradient = gradient._replace(bound=jnp.zeros_like(gradient.bound))
        change, optimiser = self.optimiser.update(gradient, agent.optimiser, agent.policy)
        policy = optax.apply_updates(agent.policy, change)
        befores = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), agent.robots, afters)
        values = jax.vmap(jax.vmap(partial(self._value, agent.slow)))(afters)

        def back(target: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            cost, value = now
            target = cost + config.discount * (TRACE * target + (1 - TRACE) * value)
            return target, target

        targets = jax.lax.scan(back, values[-1], (costs, values), reverse=True)[1]

        def miss(critic: Perceptron) -> Array:
            return ((jax.vmap(jax.vmap(partial(self._value, critic)))(befores) - targets) ** 2).mean()

        def learn(now: tuple[Perceptron, Any], _: None) -> tuple[tuple[Perceptron, Any], None]:
            critic, optimiser = now
            step, optimiser = self.critic_optimiser.update(jax.grad(miss)(critic), optimiser, critic)
            return (optax.apply_updates(critic, step), optimiser), None

        (critic, critic_optimiser), _ = jax.lax.scan(
            learn, (agent.critic, agent.critic_optimiser), None, length=CRITIC_STEPS
        )
        slow = jax.tree.map(lambda a, b: 0.9 * a + 0.1 * b, agent.slow, critic)
        begun = jax.vmap(self._begin)(jax.random.split(beginning, config.num_envs))
        ended = robots.left <= 0
        robots = jax.tree.map(
            lambda new, old: jnp.where(ended.reshape(-1, *[1] * (new.ndim - 1)), new, old), begun, robots
        )
        metrics = {
            "cost": costs.mean(), "critic_miss": miss(critic),
            "position_rms_m": jnp.sqrt((errors[..., :3] ** 2).sum(axis=-1).mean()),
            "attitude_rms_rad": jnp.sqrt((errors[..., 3:] ** 2).sum(axis=-1).mean()),
        }  # fmt: skip
        return Agent(policy, critic, slow, optimiser, critic_optimiser, robots, key), metrics


TRACE, CRITIC_STEPS = 0.95, 4
"""Weight of later costs in the critic's targets; steps of the critic a rollout."""


def _table(config: RobotTrainConfig) -> PathPoint:
    """Sample paths: places, lemniscates and Lissajous curves of many sizes and speeds, ``(paths, steps, ..)``."""
    random = generator_of(config.seed, "robot/paths")
    rows = []
    for index in range(PATHS):
        speed, length = random.uniform(*config.speeds_m_s), random.uniform(1.5, 2.5)
        kinds: tuple[Path, ...] = (
            hold(), lemniscate(speed, length, length * random.uniform(0.4, 0.6)),
            lissajous(speed, (length, length * random.uniform(0.4, 0.6), random.uniform(-0.6, 0.6))),
        )  # fmt: skip
        start = random.uniform(0, 30)
        points = [kinds[index % 3](start + step * STEP_S) for step in range(int(PATH_S / STEP_S))]
        stacked = PathPoint(*(np.stack(part) for part in zip(*points, strict=True)))
        # A turn has two quaternions; means of neighbours need the nearer one.
        signs = np.cumprod(np.sign((stacked.attitude[1:] * stacked.attitude[:-1]).sum(axis=1)))
        rows.append(stacked._replace(attitude=stacked.attitude * np.concatenate([[1.0], signs])[:, None]))
    return PathPoint(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*rows, strict=True)))


def train_policy(
    robot: RobotConfig, gaits: Sequence[FinGaits], config: RobotTrainConfig, report: Callable[[float, str], None]
) -> tuple[ResidualPolicy, list[dict[str, Any]]]:
    """Train a policy, and return it with a row of errors for every twentieth update.

    Raises:
        RunError: the training has left the finite numbers.
    """
    report(0.0, "compiling")
    trainer = Trainer(robot, gaits, config)
    agent, rows = trainer.init(), []
    for update in range(config.num_updates):
        agent, metrics = trainer.update(agent)
        if update % ROW == 0 or update == config.num_updates - 1:
            row = {name: float(value) for name, value in metrics.items()}
            if not np.isfinite(list(row.values())).all():
                raise RunError(f"robot: training left the finite numbers at update {update}; try a smaller "
                               "learning_rate")  # fmt: skip
            rows.append({"update": update, **row})
            report((update + 1) / config.num_updates, f"off by {100 * row['position_rms_m']:.1f} cm rms")
    return jax.tree.map(np.asarray, agent.policy), rows


ROW = 20
"""Updates from one row of the record to the next."""
