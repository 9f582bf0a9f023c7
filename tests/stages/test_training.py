"""The stages that make controllers: they find what the fin can do first, and leave nothing behind
that they refuse."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.gait import GaitStep
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError, ConfigurationError, PlantError
from softfin.core.quantities import Command
from softfin.gaits.force_map import MapConfig
from softfin.gaits.search import GaitConfig
from softfin.gaits.simulate import SurveyConfig
from softfin.learning.configuration import SINGLE
from softfin.stages.controllers import map_forces, train
from softfin.storage.run_directory import read_training_log
from tests.plants import NoisyFin, StrokeFin

MAP = MapConfig(
    nodes=6,
    survey=SurveyConfig(pushes=1, directions=8),
    gaits=GaitConfig(steps=2, halvings=0),
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


class Said:
    """Which searches there were."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def __call__(self, stage: str, done: float, note: str) -> None:
        if stage not in self.stages:
            self.stages.append(stage)


def test_a_map_is_a_controller_that_tells_what_the_fin_can_produce(tmp_path: Path) -> None:
    summary = map_forces(StrokeFin(), out=tmp_path / "gaits", config=MAP)
    controller = load_controller(tmp_path / "gaits")
    assert isinstance(controller.step, GaitStep)
    assert controller.reachable is not None
    box = controller.reachable.bounding_box()
    np.testing.assert_allclose((box.low, box.high), summary["box_n"], atol=1e-3)
    description = json.loads((tmp_path / "gaits" / "controller.json").read_text())
    assert description["configuration"]["nodes"] == 6
    assert (tmp_path / "gaits" / "map.png").is_file()


def test_a_plant_without_gradients_is_trained_over_its_reach(tmp_path: Path) -> None:
    result = train(Foreign(), out=tmp_path / "out", config=PPO, seed=3)
    controller = load_controller(tmp_path / "out")
    assert controller.reachable is not None
    (cell,) = controller.cells
    # A stroke of 180 degrees at pi rad/s pushes 3.1 N, and all push to +x.
    assert 2.5 < cell.high[0] < 3.3
    assert abs(controller.reachable.bounding_box().high[0] - cell.high[0]) < 1e-3
    description = controller.artifact.description
    assert description["provenance"]["seed"] == 3
    assert description["scores"] == result["scores"]
    training = tmp_path / "out" / "training"
    assert [entry["step"] for entry in read_training_log(training / "log.jsonl")] == [12]
    assert '"score_x_n"' in (training / "log.jsonl").read_text()
    assert (training / "learning.png").is_file()
    assert not (tmp_path / ".out.unfinished").exists()


@pytest.fixture
def killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Output of a training that was killed after its checkpoint."""

    def kill(*given: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patches:
        patches.setattr("softfin.learning.controllers.save_policies", kill)
        with pytest.raises(KeyboardInterrupt):
            train(StrokeFin(), out=tmp_path / "out", config=PPO)
    return tmp_path / "out"


def test_a_killed_training_resumes_and_a_finished_one_is_not_repeated(killed: Path) -> None:
    with pytest.raises(ArtifactError, match="an unfinished run; continue with --resume, or"):
        train(StrokeFin(), out=killed, config=PPO)
    with pytest.raises(ArtifactError, match=r"different run \(seed was 0 and is 1\)"):
        train(StrokeFin(), out=killed, config=PPO, seed=1, resume=True)
    result = train(StrokeFin(), out=killed, config=PPO, resume=True)
    said = Said()
    assert train(StrokeFin(), out=killed, config=PPO, resume=True, progress=said) == result
    assert said.stages == []


def test_a_plant_without_gradients_has_no_map(tmp_path: Path) -> None:
    with pytest.raises(PlantError, match="no gradient with respect to its commands"):
        map_forces(Foreign(), out=tmp_path / "gaits", config=MAP)
    assert list(tmp_path.iterdir()) == []


def test_a_range_out_of_reach_leaves_nothing_behind(tmp_path: Path) -> None:
    said = Said()
    with pytest.raises(ConfigurationError, match=r"range paper: .* its reach is x "):
        train(
            StrokeFin(gain=0.01),
            out=tmp_path / "out",
            config=PPO.changed(["range=paper"]),
            progress=said,
        )
    assert said.stages == ["survey"]
    assert list(tmp_path.iterdir()) == []


def test_a_reach_below_the_noise_leaves_nothing_behind(tmp_path: Path) -> None:
    said = Said()
    with pytest.raises(PlantError, match=r"reach of \S+ N is below the noise"):
        train(NoisyFin(noise_n=9.0), out=tmp_path / "out", config=PPO, progress=said)
    assert said.stages == ["survey"]
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_refused_before_any_search(tmp_path: Path) -> None:
    said = Said()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(ArtifactError):
        train(StrokeFin(), out=tmp_path / "out", config=PPO, progress=said)
    with pytest.raises(ArtifactError):
        map_forces(StrokeFin(), out=tmp_path / "out", config=MAP, progress=said)
    assert said.stages == []
