"""``softfin train``: what its options ask for."""

from pathlib import Path
from typing import Any

import pytest

from softfin.core.action_clock import ActionClock
from softfin.core.configuration import Changes
from softfin.core.errors import ConfigurationError, LogError
from softfin.learning.configuration import GRID, SINGLE, TrainConfig, for_clock
from softfin.stages.controllers import missed_targets, train


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Returns the configuration and the seed of a training, which is not done."""
    monkeypatch.setattr("softfin.gaits.usable.check_usable", lambda *given: None)
    monkeypatch.setattr(
        "softfin.gaits.simulate.survey", lambda *given: type("Surveyed", (), {"reachable": None})
    )

    def ask(**options: Any) -> tuple[TrainConfig, int]:
        found: list[Any] = []

        def stop(plant: Any, config: Any, reachable: Any, seed: int, *rest: Any) -> None:
            found.extend((config, seed))
            raise LogError("enough")

        monkeypatch.setattr("softfin.learning.train.train_policies", stop)
        with pytest.raises(LogError, match="enough"):
            train("tests.plants:StrokeFin", out=tmp_path / "out", **options)
        config, seed = found
        return config, seed

    return ask


def test_without_options_a_single_policy_is_trained_over_the_reach(asked: Any) -> None:
    assert asked() == (SINGLE, 0)


def test_a_grid_has_its_own_defaults(asked: Any) -> None:
    config, seed = asked(controller="grid", range="paper", steps=960, seed=4)
    assert config == GRID.merged({"range": "paper", "steps": 960}, "test")
    assert seed == 4


def test_steps_that_are_given_are_those_of_the_given_clock(asked: Any) -> None:
    config, _ = asked(clock="6,1", steps=12_000)
    expected = for_clock(SINGLE, ActionClock.at(6, 1)).merged({"steps": 12_000}, "test")
    assert config == expected


@pytest.mark.parametrize(
    ("option", "value", "field"),
    [("controller", "grid", "controller"), ("steps", 2400, "steps"), ("range", "paper", "range")],
)
def test_an_option_wins_over_the_file(
    asked: Any, tmp_path: Path, option: str, value: Any, field: str
) -> None:
    file = tmp_path / "train.yaml"
    file.write_text("controller: single\nsteps: 4800\nrange: reach\nlattice: 3\n")
    config, _ = asked(config=file, **{option: value})
    assert getattr(config, field) == value
    assert config.lattice == 3


def test_a_clock_wins_over_the_file(asked: Any) -> None:
    changes = {"task": {"clock": {"ticks": [25], "window_actions": 8}}, "ppo": {"num_steps": 60}}
    config, _ = asked(config=changes, clock="6,1")
    assert config.task.clock == ActionClock.at(6, 1)


def test_a_grid_that_a_file_asks_for_has_the_defaults_of_grids(asked: Any) -> None:
    assert asked(config={"controller": "grid"})[0] == GRID


def test_what_is_typed_is_not_scaled_with_the_clock_of_the_file(asked: Any, tmp_path: Path) -> None:
    file = tmp_path / "train.yaml"
    file.write_text("task: {clock: {ticks: [25], window_actions: 8}}\nppo: {num_steps: 60}\n")
    config, _ = asked(config=file, clock="6,1", steps=12_000)
    assert config.steps == 12_000
    typed = Changes(file, {"--ppo.num-steps": "48"})
    config, _ = asked(config=typed, clock="6,1", steps=12_000)
    assert (config.ppo.num_steps, config.steps) == (48, 12_000)


def test_numbers_of_actions_keep_their_durations_but_are_never_shortened_for_a_short_window() -> (
    None
):
    slower = for_clock(SINGLE, ActionClock.at(1, 6))
    assert slower.task.episode_actions == SINGLE.task.episode_actions
    faster = for_clock(SINGLE, ActionClock.at(6, 1))
    assert faster.task.episode_actions == 2 * SINGLE.task.episode_actions


def test_a_clock_that_does_not_exist_is_refused_before_anything_is_computed() -> None:
    with pytest.raises(ConfigurationError, match="--clock 6;1: must be paper, auto, a rate in Hz"):
        train("tank", out="out", clock="6;1")


def test_a_controller_that_misses_its_targets_is_not_written_without_a_warning() -> None:
    near = {"error_n": [0.01, 0.02], "tracked_reference_n": [0.2, 0.1]}
    far = {"error_n": [0.2, 0.2], "tracked_reference_n": [0.2, 0.1]}
    assert missed_targets([near, near]) == []
    (warning,) = missed_targets([near, far, far])
    assert warning.startswith("warning: the errors are 88% of the target forces")
