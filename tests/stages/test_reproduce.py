import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.progress import silent
from softfin.core.quantities import Command, Reading
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.scores import Scores, SurrogateUncertainty
from softfin.stages.reproduce import RESULTS, ReproduceConfig, _Reproduction, _together

ROWS = np.zeros((1, 1, 3))
RECORDING = ExperimentRecording(
    np.zeros((1, 2)), Command(ROWS, ROWS), Reading(ROWS, ROWS, ROWS, np.zeros((1, 1, 3, 2)))
)


def evaluated(distance, fraction, *warnings):
    scores = Scores(*(np.full((1, 2, 2), fraction) for _ in Scores._fields))
    uncertainty = SurrogateUncertainty(np.array([fraction]), np.array([distance]), np.array([[fraction, 3 * fraction]]))
    return Evaluation(EvaluateConfig(), scores, 2, RECORDING, uncertainty, warnings)


def test_of_several_controllers_the_furthest_distance_is_that_of_the_one_that_went_furthest():
    both = _together([evaluated(1.0, 0.1), evaluated(5.0, 0.3)])
    assert both.uncertainty.furthest.tolist() == [5.0]
    np.testing.assert_allclose(both.uncertainty.out_of_distribution_fraction, [0.2])
    np.testing.assert_allclose(both.uncertainty.half_width, [[0.2, 0.6]])
    assert both.repetitions == 2


def test_what_several_controllers_warn_of_is_said_once():
    each = [evaluated(1.0, 0.1, "one"), evaluated(1.0, 0.1, "one", "another")]
    assert _together(each).warnings == ("one", "another")


@pytest.mark.parametrize("asked", [{"moving": ["step"]}, {"error_map": 3}, {"random": 9}])
def test_experiments_that_a_reproduction_does_not_do_are_refused(asked):
    (name,) = asked
    with pytest.raises(ConfigurationError, match=rf"evaluate\.{name} is set; .* leave it out; .* softfin evaluate"):
        ReproduceConfig.build({"evaluate": asked})


def test_a_complete_run_is_kept_until_the_one_that_replaces_it_is_complete(tmp_path):
    out, kept = tmp_path / "run", tmp_path / ".run.replaced"

    def claim(overwrite):
        _Reproduction("tests.plants:AnalyticFin", out, ReproduceConfig(), 0, silent).claim(False, overwrite)

    claim(False)
    assert not kept.exists()
    (out / RESULTS).write_text("of the first run")
    claim(True)
    assert (kept / RESULTS).read_text() == "of the first run"
    assert not (out / RESULTS).exists()
    # The second run is stopped, and a third one begun.
    claim(True)
    assert (kept / RESULTS).read_text() == "of the first run"
