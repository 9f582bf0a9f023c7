"""The averaged robot, and policies that are trained in it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ArtifactError, ConfigurationError
from softfin.core.randomness import key_of
from softfin.robot.averaged import AFTER, BEFORE, STEP_S, AveragedRobot
from softfin.robot.description import load_robot
from softfin.robot.dynamics import BodyState
from softfin.robot.noise import NoiseConfig
from softfin.robot.paths import PathPoint, hold, lemniscate, twist_of
from softfin.robot.residual_policy import OBSERVED, Perceptron, ResidualPolicy, observed
from softfin.robot.train import RobotTrainConfig, Trainer

SILENT = NoiseConfig(position_m=0, attitude_rad=0, velocity_m_s=0, rate_rad_s=0)


@pytest.fixture(scope="module")
def held(ucat, gaits):
    """A robot without noise that holds its place for 40 s in a current of 4 cm/s."""
    quiet = ucat.merged({"control": {"force_noise": [1e-9] * 6}}, "test")
    model = AveragedRobot(quiet, gaits, SILENT)
    path = PathPoint(*(jnp.asarray(np.repeat(part[None], BEFORE + AFTER + 1, axis=0)) for part in hold()(0.0)))

    def act(state, key):
        return model.act(state, None, path, jnp.zeros(6), key)

    rest = jax.tree.map(jnp.float32, BodyState.rest())
    start = model.init(key_of(0, "test"), rest, jnp.array([0.04, 0.0, 0.0]), path)
    state, errors = jax.jit(lambda: jax.lax.scan(act, start, jax.random.split(key_of(1, "test"), 120)))()
    return state, np.asarray(errors).reshape(-1, 6)[:, :3]


def test_the_averaged_robot_drifts_with_a_current_and_comes_back(held):
    _, position = held
    assert 0.01 < np.abs(position[:, 0]).max() < 0.1
    assert np.linalg.norm(position[-30:], axis=1).max() < 0.003


def test_its_fins_make_more_than_the_drag_by_what_they_lose_in_the_current(held, ucat):
    state, _ = held
    asked = ucat.matrix() @ np.asarray(state.forces).ravel()
    drag = ucat.body.drag_linear[0] * 0.04 + ucat.body.drag_quadratic[0] * 0.04**2
    assert asked[0] < -1.04 * drag


def test_a_robot_on_its_path_sees_no_error(ucat, gaits):
    """Without noise, and from the first action on, though the path moves and turns."""
    quiet = ucat.merged({"control": {"force_noise": [1e-9] * 6}}, "test")
    model, lap = AveragedRobot(quiet, gaits, SILENT), lemniscate(0.08)
    points = [lap(20 + step * STEP_S) for step in range(BEFORE + AFTER + 1)]
    path = PathPoint(*(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*points, strict=True)))
    now = points[BEFORE]
    body = BodyState(*(jnp.float32(part) for part in (now.position, now.attitude, twist_of(now))))
    start = model.init(key_of(0, "test"), body, jnp.zeros(3), path)
    state, errors = model.act(start, None, path, jnp.zeros(6), key_of(1, "test"))
    assert np.abs(np.asarray(state.estimate)[:3, 0]).max() < 5e-4
    assert np.abs(np.asarray(errors)[:, :3]).max() < 5e-4


def policy_of(seed, bound=0.1):
    random = np.random.default_rng(seed)
    shapes = (OBSERVED, 8), (8,), (8, 8), (8,), (8, 6)
    weights = (random.normal(size=shape).astype(np.float32) for shape in shapes)
    return ResidualPolicy(Perceptron(*weights), np.full(6, bound))


def test_a_policy_is_bounded_and_sees_the_path_ahead():
    policy, still = policy_of(0), hold()(0.0)
    moving = still._replace(velocity=np.array([0.1, 0.0, 0.0]))
    nothing = np.zeros((6, 3)), np.zeros((2, 6))
    seen = [observed(*nothing, [still, still, still, later], policy.bound) for later in (still, moving)]
    assert np.abs(seen[0]).max() == 0
    assert np.flatnonzero(seen[1]).tolist() == [OBSERVED - 6]
    far = policy.act(np.full((6, 3), 1e6), np.full((2, 6), -1e6), [still] * 4)
    assert np.abs(far).max() <= 0.1


def test_a_policy_is_the_same_after_it_was_saved(tmp_path, ucat):
    policy, still = policy_of(1), hold()(0.0)
    policy.save(tmp_path / "policy", ucat, {"training": []})
    again = ResidualPolicy.load(tmp_path / "policy", load_robot("ucat"))
    inputs = np.ones((6, 3)), np.ones((2, 6)), [still] * 4
    np.testing.assert_array_equal(again.act(*inputs), policy.act(*inputs))
    heavier = ucat.merged({"body": {"mass_kg": 20}}, "test")
    with pytest.raises(ArtifactError, match="trained for another body"):
        ResidualPolicy.load(tmp_path / "policy", heavier)


@pytest.mark.parametrize(
    "damage", [{"last": np.zeros((8, 5), np.float32)}, {"second_bias": np.full(8, np.nan, np.float32)}]
)
def test_damaged_weights_are_refused(tmp_path, ucat, damage):
    policy = policy_of(2)
    policy._replace(network=policy.network._replace(**damage)).save(tmp_path / "policy", ucat, {})
    with pytest.raises(ArtifactError, match="its weights are not those of a policy"):
        ResidualPolicy.load(tmp_path / "policy", ucat)


def test_an_axis_without_fins_is_not_seen():
    seen = observed(np.zeros((6, 3)), np.ones((2, 6)), [hold()(0.0)] * 4, np.array([0.1, 0, 0, 0, 0, 0.1]))
    assert np.isfinite(seen).all()


def test_updates_end_with_the_episode():
    with pytest.raises(ConfigurationError, match="must divide 240"):
        RobotTrainConfig().merged({"num_steps": 32}, "test")


@pytest.mark.slow
def test_training_lowers_the_cost(ucat, gaits):
    config = RobotTrainConfig(num_envs=16, num_steps=8, num_updates=50, hidden=16, learning_rate=5e-3)
    trainer = Trainer(ucat, gaits, config)
    first = agent = trainer.init()
    for _ in range(config.num_updates):
        agent, metrics = trainer.update(agent)
    assert np.isfinite([float(value) for value in metrics.values()]).all()
    keys = jax.random.split(key_of(2, "test"), (60, 16))

    @jax.jit
    def cost(policy):
        def act(robots, keys):
            robots, outcome = jax.vmap(partial(trainer.act, policy))(robots, keys)
            return robots, jax.vmap(trainer.cost)(outcome)

        return jax.lax.scan(act, first.robots, keys)[1].mean()

    assert float(cost(agent.policy)) < 0.97 * float(cost(first.policy))
