import json
import sys

import jax
import numpy as np
import pytest
from studies.baselines import evaluate_commands, find_baselines, main, shared_limits
from studies.open_loop import OpenLoopSearch

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.tank import Tank
from tests.plants import AnalyticFin, Flapper, MisreadFin

CONFIG = EvaluateConfig(references=((1, -1), (1.5, 0)), seconds=4, seeds=2)


@pytest.fixture(scope="module")
def errors():
    """The sum of the mean errors of each baseline in x and y [N]."""
    fin = AnalyticFin(noise_n=0.0)
    search = OpenLoopSearch(fin, PAPER_LIMITS, 0, seconds=4, centres=5, amplitudes=3, gaits=40)
    found = {}
    for name, commands in find_baselines(search, CONFIG).items():
        mean = evaluate_commands(fin, commands, CONFIG).summary()["mean"]
        found[name] = mean["x"]["error_n"] + mean["y"]["error_n"]
    return found


def test_what_is_searched_beats_what_is_not(errors):
    assert errors["still"] == pytest.approx(1.75, abs=1e-6)
    assert errors["sine"] < 0.5 * errors["still"]
    assert errors["random_search"] < errors["still"]
    assert errors["recalibrated_1_hz"] < errors["inverse_1_hz"]


def flapping(seconds):
    """What `Flapper` commands, tick by tick, for two references."""
    sides = np.resize([0.8, -0.8], seconds * 3)
    angle = np.repeat(sides, np.resize(PAPER_CLOCK.ticks, seconds * 3)).astype(np.float32)
    command = Command(angle, np.full_like(angle, 3.0))
    return jax.tree.map(lambda x: np.stack([x, x]), command)


@pytest.mark.parametrize("fin", [AnalyticFin(noise_n=0.3), MisreadFin()])
def test_the_same_commands_score_the_same_as_from_a_controller(fin):
    commanded = evaluate_commands(fin, flapping(4), CONFIG)
    controlled = score_controller(Flapper(), fin, CONFIG)
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, atol=1e-4),
        commanded.scores,
        controlled.scores,
    )
    assert commanded.summary().keys() == controlled.summary().keys()


def test_in_the_tank_a_sine_about_a_positive_angle_pushes_towards_minus_y():
    """The frame of the inverse model is the tank's: about pi/4 the mean force is along (1, -1)."""
    tank = Tank()
    search = OpenLoopSearch(tank, tank.limits, 0, seconds=3)
    forces = search.forces_of_sines(np.array([[0.7854, 0.7, 1.0], [-0.7854, 0.7, 1.0]]))
    np.testing.assert_allclose(forces[:, 100:].mean(axis=1), [[1, -1], [1, 1]], atol=0.25)


def test_commands_are_those_that_both_plants_accept():
    limits = shared_limits(Limits(-1, 1.5, 0, 2), Limits(-1.5, 1.2, 1, 7))
    assert limits == Limits(-1, 1.2, 1, 2)


def test_the_command_writes_what_the_results_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.open_loop.FREQUENCIES_HZ", (1.0,))
    words = "baselines --plant tests.plants:AnalyticFin --seconds 3 --repeats 1 --gaits 4"
    words += f" --refinements 0 --out {tmp_path / 'b'}"
    monkeypatch.setattr(sys, "argv", words.split())
    main()
    written = json.loads((tmp_path / "b" / "baselines.json").read_text())
    assert {"still", "sine", "inverse_1.1_hz", "recalibrated_1.1_hz"} < written.keys()
    assert written["sine"]["mean"]["x"]["error_n"] >= 0
    assert "still: mean error" in capsys.readouterr().out
