"""The Gymnasium environment, on an analytic fin."""

import itertools
import warnings
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from matplotlib.axes import Axes

from softfin.core.errors import InputError, PlantError
from softfin.core.gym_registration import ID, register
from softfin.evaluation import fin_figure
from softfin.gaits.reachable import Cell
from softfin.gym import ForceTrackingEnv
from softfin.tank import Tank
from softfin.task.task import TaskConfig
from tests.documents import ROOT
from tests.plants import AnalyticFin

register()


@pytest.fixture(scope="module")
def make() -> Callable[..., gymnasium.Env]:
    plant = AnalyticFin()
    return lambda **changes: gymnasium.make(ID, plant=plant, **changes)


@pytest.fixture(scope="module")
def shown(make: Callable[..., gymnasium.Env]) -> gymnasium.Env:
    return make(render_mode="rgb_array")


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_check_env_passes_without_a_warning(
    make: Callable[..., gymnasium.Env], mode: str | None
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(render_mode=mode).unwrapped)


def test_it_is_made_with_the_tank_by_default_and_with_a_plant_by_name() -> None:
    assert isinstance(gymnasium.make(ID).unwrapped.task.plant, Tank)
    named = gymnasium.make(ID, plant="tests.plants:AnalyticFin").unwrapped
    assert isinstance(named.task.plant, AnalyticFin)
    with pytest.raises(PlantError, match="plant nowhere: unknown"):
        gymnasium.make(ID, plant="nowhere")


def test_several_are_made_at_once() -> None:
    envs = gymnasium.make_vec(
        ID, num_envs=2, vectorization_mode="sync", plant="tests.plants:AnalyticFin"
    )
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (2, 11)
    _, rewards, _, _, info = envs.step(np.zeros((2, 2), np.float32))
    assert rewards.shape == (2,)
    assert info["force_n"].shape == (2, 33, 2)


def test_each_action_is_drawn_and_the_same_episode_gives_the_same_frames(
    shown: gymnasium.Env,
) -> None:
    def frames() -> list[np.ndarray]:
        shown.reset(seed=3)
        made = [shown.render()]
        for angle in (0.5, -0.5):
            shown.step(np.array([angle, 1.0], np.float32))
            made.append(shown.render())
        return made

    first = frames()
    second = frames()
    assert {(frame.shape, frame.dtype) for frame in first} == {((480, 480, 3), np.dtype(np.uint8))}
    assert all((before != after).any() for before, after in itertools.pairwise(first))
    np.testing.assert_array_equal(first, second)
    assert shown.metadata["render_fps"] == 3


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Receives what is drawn: the fin's centre line and the forces."""
    received: list[np.ndarray] = []
    draw_fin = fin_figure.draw_fin

    def draw(axes: Axes, shape: np.ndarray, forces: np.ndarray, scale_n: float) -> None:
        received[:] = [shape, forces]
        draw_fin(axes, shape, forces, scale_n)

    monkeypatch.setattr(fin_figure, "draw_fin", draw)
    return received


def test_the_last_force_its_mean_and_the_reference_are_drawn(
    shown: gymnasium.Env, drawn: list[np.ndarray]
) -> None:
    _, info = shown.reset(seed=1)
    readings = []
    for k in range(8):
        readings.append(shown.step(np.array([0.4 * (-1) ** k, 0.8], np.float32))[-1]["force_n"])
        if k in (1, 7):
            shown.render()
            forces = np.concatenate(readings)
            shape, arrows = drawn
            expected = [forces[-1], forces[-200:].mean(axis=0), info["reference_n"]]
            np.testing.assert_allclose(arrows, expected, atol=1e-4)
            # This plant computes no shape: at positive angles the fin points towards +y.
            assert np.sign(shape[1, 1]) == (-1) ** k
            assert np.linalg.norm(shape[1]) == pytest.approx(0.2)


def test_the_bent_fin_of_the_tank_is_drawn(drawn: list[np.ndarray]) -> None:
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.array([0.5, 1.0], np.float32))
    env.render()
    tank = env.unwrapped.task.plant
    np.testing.assert_allclose(drawn[0], tank.shape(env.unwrapped._state.plant))
    assert len(drawn[0]) == len(tank.fin.stiffness) + 1


def test_rendering_where_nothing_can_be_drawn_is_refused(
    make: Callable[..., gymnasium.Env],
) -> None:
    env = make().unwrapped
    with pytest.raises(InputError, match='create it with render_mode="rgb_array"'):
        env.render()
    with pytest.raises(InputError, match=r"cannot render; .* call reset first"):
        make(render_mode="rgb_array").unwrapped.render()
    with pytest.raises(InputError, match="render_mode 'ansi'; must be 'rgb_array' or None"):
        ForceTrackingEnv(AnalyticFin(), render_mode="ansi")


def test_an_episode_is_truncated_after_30_s_and_never_terminates(
    make: Callable[..., gymnasium.Env],
) -> None:
    env = make()
    env.reset(seed=0)
    ticks = 0
    ends = []
    for i in range(90):
        _, _, terminated, truncated, info = env.step(np.array([0.5 * (-1) ** i, 0.5], np.float32))
        ticks += len(info["force_n"])
        ends.append((terminated, truncated))
    assert ticks == 3000
    assert ends == [(False, False)] * 89 + [(False, True)]


def test_the_clock_starts_anew_with_each_episode(make: Callable[..., gymnasium.Env]) -> None:
    env = make()
    for _ in range(2):
        env.reset()
        held = [len(env.step(np.zeros(2, np.float32))[-1]["force_n"]) for _ in range(4)]
        assert held == [33, 33, 34, 33]


def test_a_reference_can_be_asked_for(make: Callable[..., gymnasium.Env]) -> None:
    env = make(references=Cell(low=(0, -2), high=(4, 2)))
    observation, info = env.reset(options={"reference": (2, -1)})
    np.testing.assert_allclose(info["reference_n"], [2, -1])
    np.testing.assert_allclose(observation[1:3], np.array([2, -1]) / 3, rtol=1e-6)
    with pytest.raises(InputError, match=r"reference \(9, 0\) N is outside x 0 .. 4, y -2 .. 2 N"):
        env.reset(options={"reference": (9, 0)})


def test_an_unknown_option_of_a_reset_is_refused(make: Callable[..., gymnasium.Env]) -> None:
    with pytest.raises(InputError, match="unknown reset option 'ref'; use 'reference'"):
        make().reset(options={"ref": (2.0, -1.0)})


def test_observations_of_a_fin_that_turns_far_are_within_their_space() -> None:
    env = gymnasium.make(ID, plant=str(ROOT / "examples/fins/turning.yaml"))
    env.reset(seed=0)
    for angle in (1.0, 1.0, 1.0, -1.0):
        observation, *_ = env.step(np.array([angle, 1.0], np.float32))
        assert env.observation_space.contains(observation)


def test_an_action_outside_the_box_is_refused(make: Callable[..., gymnasium.Env]) -> None:
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"must be two numbers in \[-1, 1\]"):
        env.step(np.array([2.0, 0.0], np.float32))


def test_a_step_before_the_first_reset_is_refused(make: Callable[..., gymnasium.Env]) -> None:
    with pytest.raises(InputError, match="call reset first"):
        make().unwrapped.step(np.zeros(2, np.float32))


@pytest.mark.slow
def test_recurrent_ppo_of_sb3_contrib_trains_on_it(make: Callable[..., gymnasium.Env]) -> None:
    sb3 = pytest.importorskip(
        "sb3_contrib", reason="the extra sb3 is not installed: 5 GB, which CI leaves out"
    )
    config = TaskConfig(episode_actions=30)
    model = sb3.RecurrentPPO(
        "MlpLstmPolicy", make(config=config), n_steps=64, batch_size=64, n_epochs=2, seed=0
    )
    before = [p.detach().numpy().copy() for p in model.policy.parameters()]
    model.learn(128)
    after = [p.detach().numpy() for p in model.policy.parameters()]
    assert (
        sum(p.size for p in after) == 592_325
    )  # the paper's weights follow from 11 observations and k = 3
    assert any(np.abs(a - b).max() > 0 for a, b in zip(after, before, strict=True))
    assert all(np.isfinite(a).all() for a in after)
