import numpy as np

from softfin.evaluation.doubt import Doubt
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation
from softfin.evaluation.experiment import Recording
from softfin.evaluation.scores import Scores
from softfin.quantities import Command, Reading
from softfin.reproduction import _together

ROWS = np.zeros((1, 1, 3))
RECORDING = Recording(np.zeros((1, 2)), Command(ROWS, ROWS), Reading(ROWS, ROWS, ROWS, np.zeros((1, 1, 3, 2))))


def judged(distance, share):
    scores = Scores(*(np.full((1, 2, 2), share) for _ in Scores._fields))
    doubt = Doubt(np.array([share]), np.array([distance]), np.array([[share, 3 * share]]))
    return Evaluation(EvaluateConfig(), scores, 2, RECORDING, doubt)


def test_of_several_controllers_the_furthest_distance_is_that_of_the_one_that_went_furthest():
    both = _together([judged(1.0, 0.1), judged(5.0, 0.3)])
    assert both.doubt.furthest.tolist() == [5.0]
    np.testing.assert_allclose(both.doubt.beyond, [0.2])
    np.testing.assert_allclose(both.doubt.half_width, [[0.2, 0.6]])
    assert both.repetitions == 2
