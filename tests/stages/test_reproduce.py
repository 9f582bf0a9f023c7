import errno
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from softfin.core.configuration import configure
from softfin.core.errors import ArtifactError, RunError
from softfin.core.progress import silent
from softfin.core.quantities import Command, Reading
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, together
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.scores import Scores
from softfin.gaits.force_map import MapConfig
from softfin.learning.configuration import TRAIN_PRESETS
from softfin.stages import reproduce
from softfin.stages.surrogates import _predict_test
from softfin.surrogate import save_surrogate
from softfin.surrogate.registry import find_architecture
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


def claim(out, seed=0, resume=False, overwrite=False):
    reproduce._claim(out, "tests.plants:AnalyticFin", "demo", seed, resume, overwrite)


def test_with_resume_and_overwrite_another_run_is_replaced_and_the_same_one_goes_on(tmp_path):
    out = tmp_path / "run"
    claim(out, resume=True)
    (out / "dataset").mkdir()
    with pytest.raises(ArtifactError, match="already exists"):
        claim(out)
    claim(out, resume=True, overwrite=True)
    assert (out / "dataset").exists()
    with pytest.raises(
        ArtifactError,
        match=r"belongs to a different run \(seed was 0 and is 1\).*or use --overwrite",
    ):
        claim(out, 1, resume=True)
    claim(out, 1, resume=True, overwrite=True)
    assert not (out / "dataset").exists()


def finish(out):
    """Complete a run."""
    (out / "dataset").mkdir()
    (out / reproduce.RESULTS).write_text("{}")


def test_a_run_is_replaced_through_a_link(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "disk" / "run")
    claim(link)
    for complete in (True, False):
        (link / "fit").mkdir()
        if complete:
            finish(link)
        claim(link, overwrite=True)
        assert [file.name for file in link.iterdir()] == ["reproduction.json"]
    assert link.is_symlink()


def test_a_complete_run_is_kept_until_the_next_one_is_complete(tmp_path, monkeypatch):
    def run(fail=False):
        def work(progress):
            assert not fail

        stage = reproduce.Stage("fit", "a surrogate", out / "fit", work)
        monkeypatch.setattr(reproduce, "_list_stages", lambda *_: [stage])
        reproduce.reproduce(out=out, plant="tests.plants:AnalyticFin", overwrite=True)

    out = tmp_path / "run"
    kept = tmp_path / ".run.before"
    monkeypatch.setattr("softfin.evaluation.report.write_report", lambda *_: None)
    claim(out)
    finish(out)
    for _ in range(2):
        with pytest.raises(AssertionError):
            run(fail=True)
        assert (kept / "dataset").is_dir()
    run()
    assert sorted(place.name for place in tmp_path.iterdir()) == ["run"]
    assert (out / reproduce.RESULTS).is_file()


def test_a_run_that_cannot_be_removed_is_not_taken_for_the_new_one(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    out = tmp_path / "run"
    claim(out)
    monkeypatch.setattr("shutil.rmtree", refuse)
    with pytest.raises(RunError, match=r"run: cannot be replaced \(Permission denied\); .*--out"):
        claim(out, 1, overwrite=True)


def test_only_a_reproduction_that_does_not_contain_the_plant_is_replaced(tmp_path):
    save_surrogate(
        tmp_path / "fin", small.surrogate(), None, {"data_hash": "dataset"}, configuration={}
    )
    with pytest.raises(ArtifactError, match=r"fin: .*not a softfin reproduction.*--out"):
        claim(tmp_path / "fin", overwrite=True)
    out = tmp_path / "run"
    claim(out)
    (tmp_path / "fin").rename(out / "fin")
    (tmp_path / "link").symlink_to(out / "fin")
    with pytest.raises(ArtifactError, match=r"run: contains .*link.*--out"):
        reproduce._claim(out, str(tmp_path / "link"), "demo", 0, False, True)
    assert (out / "fin").is_dir()


@pytest.mark.parametrize("changed", ["plant", "configuration.num_seeds", "software"])
def test_a_run_of_another_plant_preset_or_version_is_not_continued(tmp_path, monkeypatch, changed):
    out = tmp_path / "run"
    claim(out)
    plant = "tests.plants:AnalyticFin"
    if changed == "plant":
        plant = "tank"
    elif changed == "software":
        monkeypatch.setattr("importlib.metadata.version", lambda name: "99")
    else:
        preset = reproduce.PRESETS["demo"]._replace(num_seeds=7)
        monkeypatch.setattr(reproduce, "PRESETS", {"demo": preset})
    with pytest.raises(ArtifactError, match=rf"run: belongs to a different run .*{changed} was"):
        reproduce._claim(out, plant, "demo", 0, True, False)


@pytest.mark.parametrize("file", ["evaluation/gaits/evaluation.json", reproduce.RESULTS])
def test_an_empty_result_is_one_line(tmp_path, monkeypatch, file):
    """As a power cut leaves it."""
    out = tmp_path / "run"
    monkeypatch.setattr(reproduce, "_list_stages", lambda *_: [])
    claim(out)
    (out / file).parent.mkdir(parents=True, exist_ok=True)
    (out / file).touch()
    with pytest.raises(ArtifactError, match=rf"{file}: cannot be read as JSON .*; .*--"):
        reproduce.reproduce(out=out, plant="tests.plants:AnalyticFin", preset="demo", resume=True)


def test_a_stage_whose_result_exists_is_skipped(tmp_path):
    done = []

    def work(progress):
        progress("fit", 0.5, "half")
        done.append(progress)

    said = []
    stage = reproduce.Stage("fit", "a surrogate", tmp_path / "surrogate", work)
    row = reproduce._run(stage, "2/9 fit", lambda *report: said.append(report))
    assert row["wall_s"] >= 0
    assert said == [("2/9 fit", 0.0, ""), ("2/9 fit", 0.5, "half")]
    (tmp_path / "surrogate").mkdir()
    assert reproduce._run(stage, "2/9 fit", silent)["wall_s"] is None
    assert len(done) == 1


@pytest.mark.parametrize("preset", reproduce.PRESETS)
def test_the_configurations_of_a_preset_fit_their_stages(preset):
    changes = reproduce.PRESETS[preset]
    configure(CollectConfig(), changes.collect)
    configure(find_architecture(changes.model).config(), changes.fit)
    configure(MapConfig(), changes.gaits)
    for kind, policy in changes.policies.items():
        configure(TRAIN_PRESETS[kind], policy)
    configure(EvaluateConfig(), {"recorded": reproduce.ONE_STEP, **changes.evaluate})


def test_of_a_surrogate_nothing_is_collected_or_fitted(tmp_path):
    save_surrogate(
        tmp_path / "fin", small.surrogate(), None, {"data_hash": "dataset"}, configuration={}
    )
    fin = str(tmp_path / "fin")
    stages = reproduce._list_stages(tmp_path / "run", fin, reproduce.PRESETS["tiny"], 3)
    names = [stage.name for stage in stages]
    assert names[:3] == ["map", "train single-3", "train single-4"]
    assert not any("in-surrogate" in name for name in names)
    assert names[-1] == "explore"


def test_the_controllers_of_the_first_seed_can_be_tried_in_a_page_where_their_plants_can_move_in_one(
    tmp_path,
):
    for kind in ("gaits", "single"):
        folder_option(kind, tmp_path / "made").rename(tmp_path / kind)
    save_surrogate(
        tmp_path / "surrogate", small.surrogate(), None, {"data_hash": "dataset"}, configuration={}
    )
    page = tmp_path / "explore.html"
    controllers = [tmp_path / "gaits", tmp_path / "single"]
    plants = (str(tmp_path / "surrogate"), "tank")
    reproduce._write_page(controllers, page, plants, progress=silent)
    assert re.findall(r"<option value=\"\d\">([^<]*)<", page.read_text().partition("Speed")[0]) == [
        "gaits",
        "single",
        "by hand",
        "tank",
        "surrogate",
    ]
    other = tmp_path / "other.html"
    reproduce._write_page(controllers, other, ("tests.plants:AnalyticFin",) * 2, progress=silent)
    assert not other.exists()


@pytest.mark.parametrize("kind", [paper, small], ids=["paper", "streaming"])
def test_a_test_log_is_drawn_with_each_prediction_of_its_force(kind, monkeypatch):
    log = paper.log(900)
    drawn = {}

    def draw(measured, predicted, start_s):
        drawn.update(predicted, measured=measured)
        return Figure()

    monkeypatch.setattr("softfin.evaluation.report.prediction_figure", draw)
    _predict_test(kind.surrogate(), log)
    first = 450
    np.testing.assert_array_equal(drawn.pop("measured"), log.reading.force[first:])
    _, *networks = kind.surrogate().predictions([log]).values()
    for network in networks:
        expected = network.series[0][-len(log.reading.force[first:]) :]
        np.testing.assert_array_equal(drawn.pop(network.title), expected)
    assert drawn == {}
