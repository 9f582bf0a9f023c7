"""The stage that trains: it finds what the fin can do first, and leaves nothing behind that it
refuses."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError, ConfigurationError, PlantError
from softfin.core.quantities import Command
from softfin.gaits.gait import FinForces
from softfin.learning.configuration import GRADIENT_SINGLE, SINGLE, TrainConfig, fit_to_reach
from softfin.stages.controllers import train
from tests.plants import NoisyFin, StrokeFin

QUICK = GRADIENT_SINGLE.changed(
    (
        "steps=12",
        "num_evaluations=1",
        "lattice=1",
        "policy.units=8",
        "policy.width=8",
        "gradient.num_envs=2",
        "gradient.num_steps=3",
        "task.episode_actions=9",
        "gradient.map.nodes=6",
        "gradient.map.survey.pushes=1",
        "gradient.map.survey.directions=8",
        "gradient.map.gaits.steps=2",
        "gradient.map.gaits.halvings=0",
    )
)
PPO = SINGLE.changed(
    (
        "steps=12",
        "num_evaluations=1",
        "lattice=1",
        "policy.units=8",
        "policy.width=8",
        "task.episode_actions=9",
        "ppo.num_envs=2",
        "ppo.num_steps=6",
        "ppo.num_minibatches=1",
    )
)


class Foreign(StrokeFin):
    """A fin that computes beyond JAX."""

    @property
    def identity(self) -> str:
        return "foreign"

    def advance(self, state: Any, command: Command, ticks: int) -> Any:
        angle = jax.pure_callback(
            np.asarray,
            jax.ShapeDtypeStruct((), jnp.float32),
            command.angle,
            vmap_method="broadcast_all",
        )
        return super().advance(state, Command(angle, command.velocity), ticks)


def over(low: tuple[float, float], high: tuple[float, float]) -> Callable[..., TrainConfig]:
    """A configuration for a range that was asked for."""

    def make(forces: FinForces) -> TrainConfig:
        return fit_to_reach(QUICK, forces).merged({"cells": [{"low": low, "high": high}]}, "test")

    return make


class Said:
    """Which searches there were, and Ctrl-C in the middle of one."""

    def __init__(self, stop_in: str | None = None) -> None:
        self.stages: list[str] = []
        self.stop_in = stop_in

    def __call__(self, stage: str, done: float, note: str) -> None:
        if stage not in self.stages:
            self.stages.append(stage)
        if stage == self.stop_in:
            raise KeyboardInterrupt


def test_a_plant_without_gradients_is_trained_over_its_reach(tmp_path: Path) -> None:
    train(Foreign(), tmp_path / "out", partial(fit_to_reach, PPO))
    controller = load_controller(tmp_path / "out")
    assert controller.reachable is not None
    (cell,) = controller.cells
    # A stroke of 180 degrees at pi rad/s pushes 3.1 N, and all push to +x.
    assert 2.5 < cell.high[0] < 3.3
    assert abs(controller.reachable.bounding_box().high[0] - cell.high[0]) < 1e-3


def test_a_range_out_of_reach_leaves_nothing_behind(tmp_path: Path) -> None:
    said = Said()
    with pytest.raises(ConfigurationError, match=r"range x 5 \.\. 6, .* its reach is x "):
        train(StrokeFin(), tmp_path / "out", over((5, 5), (6, 6)), progress=said)
    assert said.stages == ["survey"]
    assert list(tmp_path.iterdir()) == []


def test_a_fixed_range_out_of_reach_is_refused_too(tmp_path: Path) -> None:
    config = QUICK.changed(["cells=[{low: [5, 5], high: [6, 6]}]"])
    with pytest.raises(ConfigurationError, match=r"range x 5 \.\. 6, .* its reach is x "):
        train(StrokeFin(), tmp_path / "out", config)
    assert not (tmp_path / "out").exists()


def test_a_reach_below_the_noise_leaves_nothing_behind(tmp_path: Path) -> None:
    said = Said()
    with pytest.raises(PlantError, match=r"reach of \S+ N is below the noise"):
        train(NoisyFin(noise_n=9.0), tmp_path / "out", partial(fit_to_reach, QUICK), progress=said)
    assert said.stages == ["survey"]
    with pytest.raises(PlantError, match=r"reach of \S+ N is below the noise"):
        train(NoisyFin(noise_n=9.0), tmp_path / "out", QUICK)
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_refused_before_any_search(tmp_path: Path) -> None:
    said = Said()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(ArtifactError):
        train(StrokeFin(), tmp_path / "out", over((1, -1), (2, 1)), progress=said)
    assert said.stages == []


def test_a_run_that_was_stopped_keeps_its_gaits(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        train(StrokeFin(), out, over((1, -1), (2, 1)), progress=Said(stop_in="train single"))
    with pytest.raises(ArtifactError, match="unfinished run"):
        train(StrokeFin(), out, over((1, -1), (2, 1)), progress=(early := Said()))
    assert early.stages == []
    with pytest.raises(ArtifactError, match="another run"):
        train(StrokeFin(), out, over((1, -1), (2.5, 1)), resume=True, progress=(other := Said()))
    assert other.stages == []
    again = Said()
    train(StrokeFin(), out, over((1, -1), (2, 1)), resume=True, progress=again)
    assert again.stages == ["survey", "train single"]
    assert load_controller(out).cells[0].high == (2, 1)
