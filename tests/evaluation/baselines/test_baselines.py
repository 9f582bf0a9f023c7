import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.plant import rest_command
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from softfin.evaluation.baselines.baselines import (
    BaselinesConfig,
    evaluate_baselines,
    evaluate_commands,
    shared_limits,
    write_baselines,
)
from softfin.evaluation.baselines.open_loop import (
    OpenLoopSearch,
    SearchConfig,
    force_errors,
    repeated,
)
from softfin.evaluation.evaluate import score_controller
from tests.plants import AnalyticFin, MisreadFin

SEARCH = SearchConfig(
    seconds=4, centres=5, amplitudes=3, frequencies_hz=(1.0,), kept=2, refinements=1, gaits=40
)
REFERENCES = ((1, -1), (1.5, 0))
CONFIG = BaselinesConfig(references=REFERENCES, seconds=4, seeds=2, search=SEARCH)


class Still(eqx.Module):
    """Gives the rest command always."""

    def init(self):
        return jnp.zeros(())

    def act(self, state, measured, reference):
        return state, rest_command(PAPER_LIMITS)

    def check(self, reference):
        """Covers everything."""


def searching(seed=0, gain=0.5, **changes):
    fin = AnalyticFin(gain=gain, noise_n=0.0)
    return OpenLoopSearch(fin, PAPER_LIMITS, SEARCH.model_copy(update=changes), seed)


@pytest.fixture(scope="module")
def found():
    fin = AnalyticFin(noise_n=0.0)
    notes = []
    baselines = evaluate_baselines(fin, fin, CONFIG, lambda done, note: notes.append(done))
    assert notes == sorted(notes)
    assert notes[-1] == 1
    return baselines


def mean_error(found, name):
    mean = found["baselines"][name]["mean"]
    return mean["x"]["error_n"] + mean["y"]["error_n"]


def test_every_baseline_has_the_layout_of_an_evaluation(found):
    inverses = {
        f"{kind}_{f}_hz" for kind in ("inverse", "recalibrated") for f in ("2.1", "1.1", "1")
    }
    assert set(found["baselines"]) == {"still", "sine", "random_search"} | inverses
    assert found["left_out"] == {}
    for summary in found["baselines"].values():
        assert [tuple(row["reference_n"]) for row in summary["references"]] == list(REFERENCES)
        assert {"conditions", "references", "mean", "warning"} <= set(summary)


def test_a_still_fin_misses_each_reference_by_its_size(found):
    for row in found["baselines"]["still"]["references"]:
        assert row["still"]
        for axis, wanted in zip("xy", row["reference_n"], strict=True):
            assert row[axis]["error_n"] == pytest.approx(abs(wanted), abs=1e-6)


def test_baselines_are_judged_by_the_true_force_as_controllers_are():
    """The sensor of this fin is off by 0.4 N in x."""
    commands = Command(np.zeros((2, 400)), np.full((2, 400), PAPER_LIMITS.velocity_min))
    baseline = evaluate_commands(MisreadFin(), commands, CONFIG.experiments).summary()
    controller = score_controller(Still(), MisreadFin(), CONFIG.experiments).summary()
    assert (
        baseline["conditions"]["judged_by"] == controller["conditions"]["judged_by"] == "true force"
    )
    for axis in "xy":
        assert baseline["mean"][axis]["error_n"] == pytest.approx(
            controller["mean"][axis]["error_n"], abs=1e-4
        )
    assert abs(baseline["mean"]["x"]["reading_error_n"] - baseline["mean"]["x"]["error_n"]) > 0.1


def test_what_is_searched_beats_what_is_not(found):
    assert mean_error(found, "sine") < 0.5 * mean_error(found, "still")
    assert mean_error(found, "recalibrated_1_hz") < mean_error(found, "inverse_1_hz")
    assert mean_error(found, "random_search") < mean_error(found, "still")


def test_what_the_limits_clip_is_said_for_each_reference(found):
    """A sine of 1.2 rad and 1.1 Hz turns at 8 rad/s; the fin may be told 3.1."""
    rows = [row["commanded"] for row in found["baselines"]["inverse_1.1_hz"]["references"]]
    assert all(row["velocity_clipped"] > 0.5 for row in rows)
    rows = [row["commanded"] for row in found["baselines"]["inverse_2.1_hz"]["references"]]
    assert [row["amplitude_limited"] for row in rows] == [False, False]
    assert [row["centre_rad"] for row in rows] == [pytest.approx(np.pi / 4, abs=1e-4), 0.0]


def test_each_round_refines_the_sine_for_each_reference():
    references = np.array([(0.6, -0.5), (0.8, 0.1)])

    def losses(refinements):
        search = searching(refinements=refinements)
        forces = search.forces_of_sines(np.stack(search.best_sines(references), axis=1))
        return np.diag(force_errors(forces, references))

    assert (losses(3) < 0.5 * losses(0)).all()


def test_a_gait_is_six_actions_on_the_clock_again_and_again():
    command = repeated(Command(np.arange(6.0), np.arange(6.0) + 1), 5)
    assert command.angle.shape == (500,)
    starts = np.concatenate([[0], np.cumsum(PAPER_CLOCK.ticks * 2)])
    for i in range(6):
        np.testing.assert_array_equal(command.angle[starts[i] : starts[i + 1]], i)
    np.testing.assert_array_equal(command.angle[400:], command.angle[:100])


def test_more_gaits_are_never_worse_and_the_same_seed_gives_the_same():
    references = np.array(REFERENCES, np.float64)

    def gaits(count, seed=0):
        return searching(seed, gaits=count).best_gaits(references)

    np.testing.assert_array_equal(gaits(40).angle, gaits(40).angle)
    assert not np.array_equal(gaits(40).angle, gaits(40, seed=1).angle)
    many, few = (
        np.diag(force_errors(searching().forces(repeated(gaits(n), 4)), references))
        for n in (40, 1)
    )
    assert (many <= few).all()


def test_a_stronger_fin_has_a_greater_constant():
    constants = [searching(gain=gain).fitted_constant(1.0, (0.1, 1.2)) for gain in (0.5, 1.0)]
    assert constants[1] == pytest.approx(2 * constants[0], rel=1e-3)


def test_a_fin_that_pulls_is_left_out_in_words():
    fin = AnalyticFin(gain=-0.5, noise_n=0.0)
    config = CONFIG.changed(["inverse_frequencies_hz=[1.0]"])
    left_out = evaluate_baselines(fin, fin, config)["left_out"]
    assert "against the zero direction" in left_out["recalibrated_1_hz"]


def test_commands_are_those_that_both_plants_take():
    limits = shared_limits(Limits(-1, 1.5, 0, 2), Limits(-1.5, 1.2, 1, 7))
    assert limits == Limits(-1, 1.2, 1, 2)
    with pytest.raises(
        PlantError,
        match=r"have no valid commands in common.*search in a surrogate of the evaluated fin",
    ):
        shared_limits(Limits(-1, 1, 0, 0.9), Limits(-1, 1, 1, 7))


def test_the_file_holds_all_of_it(found, tmp_path):
    write_baselines(found | {"plant": "analytic"}, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "baselines.json").read_text())
    assert written["baselines"] == found["baselines"]
    assert (written["left_out"], written["plant"]) == ({}, "analytic")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"inverse_frequencies_hz": [0]}, "greater than 0"),
        ({"search": {"gaits": 0}}, "greater than 0"),
    ],
)
def test_what_makes_no_sense_is_refused(values, words):
    with pytest.raises(ConfigurationError, match=words):
        BaselinesConfig.build(values)
