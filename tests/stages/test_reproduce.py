import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from softfin.core.errors import ArtifactError, ConfigurationError
from softfin.core.progress import silent
from softfin.core.quantities import Command, Reading
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, together
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.report import write_report
from softfin.evaluation.scores import Scores
from softfin.stages.reproduce import RESULTS, _Reproduction
from softfin.stages.reproduce_config import PRESETS, ReproduceConfig
from softfin.storage.dataset import write_dataset
from softfin.surrogate import save_surrogate
from tests.control.folders import folder_option
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

ROWS = np.zeros((1, 1, 3))
RECORDING = ExperimentRecording(
    np.zeros((1, 2)), Command(ROWS, ROWS), Reading(ROWS, ROWS, ROWS, np.zeros((1, 1, 3, 2)))
)


def evaluated(distance, fraction, *warnings):
    scores = Scores(*(np.full((1, 2, 2), fraction) for _ in Scores._fields))
    return Evaluation(EvaluateConfig(), scores, 2, RECORDING, np.array([[0.0, distance]]), warnings)


def test_of_several_controllers_the_furthest_distance_is_that_of_the_one_that_went_furthest():
    both = together([evaluated(1.0, 0.1), evaluated(5.0, 0.3)])
    assert both.distance.tolist() == [[0.0, 1.0, 0.0, 5.0]]
    assert both.repetitions == 2


def test_what_several_controllers_warn_of_is_said_once():
    each = [evaluated(1.0, 0.1, "one"), evaluated(1.0, 0.1, "one", "another")]
    assert together(each).warnings == ("one", "another")


def test_controllers_with_different_clocks_are_refused_before_any_work():
    with pytest.raises(ConfigurationError, match=r"single\.task\.clock is .*, but gaits\.clock is"):
        PRESETS["tiny"].changed(["gaits.clock.ticks=[25]", "gaits.clock.window_actions=8"])


@pytest.mark.parametrize("asked", [{"error_map": 3}, {"random": 9}])
def test_experiments_that_a_reproduction_does_not_do_are_refused(asked):
    (name,) = asked
    with pytest.raises(
        ConfigurationError, match=rf"evaluate\.{name} is set, .* omit it, .* softfin evaluate"
    ):
        ReproduceConfig.build({"evaluate": asked})


def test_a_complete_run_is_kept_until_the_one_that_replaces_it_is_complete(tmp_path):
    out = tmp_path / "run"
    kept = tmp_path / ".run.replaced"

    def claim(overwrite):
        _Reproduction("tests.plants:AnalyticFin", out, ReproduceConfig(), 0, silent).claim(
            False, overwrite
        )

    claim(False)
    assert not kept.exists()
    (out / RESULTS).write_text("of the first run")
    claim(True)
    assert (kept / RESULTS).read_text() == "of the first run"
    assert not (out / RESULTS).exists()
    # The second run is stopped, and a third one begun.
    claim(True)
    assert (kept / RESULTS).read_text() == "of the first run"


def test_with_resume_and_overwrite_another_run_is_replaced_and_the_same_one_goes_on(tmp_path):
    out = tmp_path / "run"

    def claim(seed, overwrite):
        _Reproduction("tests.plants:AnalyticFin", out, ReproduceConfig(), seed, silent).claim(
            True, overwrite
        )

    claim(0, overwrite=False)
    (out / "dataset").mkdir()
    claim(0, overwrite=True)
    assert (out / "dataset").exists()
    with pytest.raises(
        ArtifactError, match=r"belongs to another run \(seed was 0 and is 1\).*or use --overwrite"
    ):
        claim(1, overwrite=False)
    claim(1, overwrite=True)
    assert not (out / "dataset").exists()


def test_the_controllers_of_the_first_seed_can_be_tried_in_a_page_where_their_plants_can_move_in_one(
    tmp_path,
):
    config = PRESETS["tiny"].model_copy(update={"grid": None})
    for kind, place in (
        ("gaits", "gaits"),
        ("single", "single-3"),
        ("single", "single-4"),
    ):
        folder_option(kind, tmp_path / "made").rename(tmp_path / place)
    save_surrogate(
        tmp_path / "surrogate", small.surrogate(), None, {"data_hash": "dataset"}, configuration={}
    )
    run = _Reproduction("tank", tmp_path, config, 3, silent)
    run.make_page()
    page = (tmp_path / "explore.html").read_text()
    assert re.findall(r"<option value=\"\d\">([^<]*)<", page.partition("Speed")[0]) == [
        "gaits",
        "single",
        "by hand",
        "tank",
        "surrogate",
    ]
    (stage,) = run.stages
    assert stage["page"] == "explore.html"
    write_report(tmp_path / "report.html", {"stages": run.stages})
    assert (
        '<a href="explore.html">A page to drag the target force'
        in (tmp_path / "report.html").read_text()
    )


@pytest.mark.parametrize("kind", [paper, small], ids=["paper", "streaming"])
def test_a_test_log_is_drawn_with_each_prediction_of_its_force(kind, tmp_path, monkeypatch):
    """A network that is given the measured angle is drawn, too, if there is no ensemble."""
    log = paper.log(900)
    write_dataset(tmp_path / "dataset", [log], [log], {})
    save_surrogate(tmp_path / "surrogate", kind.surrogate(), None, {})
    drawn = {}

    def draw(measured, predicted, start_s):
        drawn.update(predicted, measured=measured)
        return Figure()

    monkeypatch.setattr("softfin.stages.reproduce.prediction_figure", draw)
    _Reproduction("tank", tmp_path, PRESETS["tiny"], 0, silent).surrogate_figures()
    first = 450
    np.testing.assert_array_equal(drawn.pop("measured"), log.reading.force[first:])
    assert drawn.pop("free-running").shape == (900 - first, 2)
    if kind is paper:
        given = paper.surrogate().predict_force(log, free_running=False)
        expected = given[first - paper.WINDOW :]
        np.testing.assert_allclose(drawn.pop("given the angle"), expected, rtol=1e-5, atol=1e-5)
    assert drawn == {}
