"""Another clock than the paper's goes through the whole pipeline: map, training, evaluation."""

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

from softfin.control.controller import Measured
from softfin.control.feedback import Feedback
from softfin.control.policy import PolicyObservation
from softfin.control.store import load_controller
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ConfigurationError
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.gaits.simulate import gait_families
from softfin.learning.configuration import GRID, SINGLE, for_clock
from softfin.stages.controllers import map_forces, train
from tests.plants import StrokeFin
from tests.stages.test_training import MAP, PPO


def _mapped(clock: ActionClock, out: Path) -> Path:
    map_forces(StrokeFin(), out=out, config=MAP.model_copy(update={"clock": clock}))
    return out


def _trained(clock: ActionClock, out: Path) -> Path:
    train(StrokeFin(), out=out, config=for_clock(PPO, clock))
    return out


@pytest.mark.parametrize(
    ("make", "clock"),
    [
        (_mapped, ActionClock.at(10, 1)),
        (_mapped, ActionClock.at(2.5, 1.2)),
        (_trained, ActionClock.at(6)),
    ],
)
def test_a_controller_of_another_clock(
    make: Callable[[ActionClock, Path], Path], clock: ActionClock, tmp_path: Path
) -> None:
    controller = load_controller(make(clock, tmp_path / "out"))
    assert controller.clock == clock
    if make is _mapped:
        assert controller.step.table.gait_actions == clock.window_actions
    observed = Feedback(controller)
    assert observed.clock == clock
    config = EvaluateConfig(seconds=4, seeds=1, references=((1, 0),))
    summary = score_controller(observed, StrokeFin(), config).summary()
    assert summary["conditions"]["window_samples"] == clock.window_ticks
    assert summary["conditions"]["action_rate_hz"] == pytest.approx(clock.rate_hz)
    # The same step in NumPy, on a robot.
    state = controller.init()
    for _ in range(clock.window_actions + 1):
        state, command = controller.act(state, Measured(0.0, (0.0, 0.0)), (1.0, 0.0))
    jitted = jax.jit(
        lambda state: controller.act(
            state, Measured(jax.numpy.float32(0), jax.numpy.zeros(2)), jax.numpy.array([1.0, 0.0])
        )
    )
    state = controller.init()
    for _ in range(clock.window_actions + 1):
        state, traced = jitted(state)
    np.testing.assert_allclose(traced.angle, command.angle, atol=1e-4)


def test_an_experiment_shorter_than_the_window_is_refused(tmp_path: Path) -> None:
    controller = load_controller(_mapped(ActionClock.at(2, 6), tmp_path / "out"))
    config = EvaluateConfig(seconds=6, seeds=1, references=((1, 0),))
    with pytest.raises(ConfigurationError, match=r"seconds = 6: too short .*; use at least 7"):
        score_controller(controller, StrokeFin(), config)


def test_windows_of_an_odd_number_of_actions_are_surveyed_with_strokes() -> None:
    for waveform, _ in gait_families(ActionClock.at(5, 1)):
        assert waveform.shape == (5,)
    waveforms = {tuple(waveform) for waveform, _ in gait_families(ActionClock.at(5, 1))}
    assert (1.0, -1.0, 1.0, -1.0, 0.0) in waveforms


def test_durations_of_a_preset_do_not_depend_on_the_clock() -> None:
    clock = ActionClock.at(6)
    for preset in (SINGLE, GRID):
        config = for_clock(preset, clock)
        assert config.task.reference_actions == 2 * preset.task.reference_actions
        assert config.num_updates == preset.num_updates


def test_the_clock_of_a_controllers_file_is_that_of_its_policies() -> None:
    clock = ActionClock.at(5, 1.2)
    task = PolicyObservation().model_dump()
    description = {"task": task, "clock": clock.model_dump(mode="json")}
    assert PolicyObservation.from_description(description).clock == clock
