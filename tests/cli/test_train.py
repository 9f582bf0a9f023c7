"""``softfin train``: what its options ask for."""

from pathlib import Path
from typing import Any

import pytest

from softfin.cli.controllers import TrainArguments, missed_targets
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ConfigurationError
from softfin.learning.configuration import GRID, SINGLE, for_clock

SCORES = [{"reference_n": [1, 0], "tracked_reference_n": [1, 0], "error_n": [0.1, 0.2]}]


def asked(monkeypatch: pytest.MonkeyPatch, **options: Any) -> dict[str, Any]:
    """What the stage is called with."""
    given: dict[str, Any] = {}

    def train(plant: str, out: Path, config: Any, **rest: Any) -> Any:
        given.update(rest, plant=plant, out=out, config=config)
        return {"controller": str(out), "scores": SCORES}

    monkeypatch.setattr("softfin.stages.controllers.train", train)
    TrainArguments(surrogate="tank", out=Path("out"), **options)()
    return given


def test_without_options_a_single_policy_is_trained_over_the_reach(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = asked(monkeypatch)
    assert given["config"] == SINGLE
    assert given["seed"] == 0
    assert "( 1.00,  0.00)  0.100, 0.200" in capsys.readouterr().out


def test_a_grid_has_its_own_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    given = asked(monkeypatch, controller="grid", range="paper", steps=960, seed=4)
    assert given["config"] == GRID.merged({"range": "paper", "steps": 960}, "test")
    assert given["seed"] == 4


def test_a_run_is_resumed_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not asked(monkeypatch)["resume"]
    assert asked(monkeypatch, resume=True)["resume"]


def test_steps_that_are_given_are_those_of_the_given_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    given = asked(monkeypatch, clock="6,1", steps=12_000)
    expected = for_clock(SINGLE, ActionClock.at(6, 1)).merged({"steps": 12_000}, "test")
    assert given["config"] == expected


def test_a_clock_that_does_not_exist_is_refused_before_anything_is_computed() -> None:
    with pytest.raises(ConfigurationError, match="--clock 6;1: must be paper, auto, a rate in Hz"):
        TrainArguments(surrogate="tank", out=Path("out"), clock="6;1").check()


def test_a_controller_that_misses_its_targets_is_not_written_without_a_warning() -> None:
    near = {"error_n": [0.01, 0.02], "tracked_reference_n": [0.2, 0.1]}
    far = {"error_n": [0.2, 0.2], "tracked_reference_n": [0.2, 0.1]}
    assert missed_targets([near, near]) == []
    (warning,) = missed_targets([near, far, far])
    assert warning.startswith("warning: the errors are 88% of the target forces")
