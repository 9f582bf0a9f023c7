import numpy as np
import pytest

from softfin.core.errors import RunError
from softfin.tank.calibration.search import FAILED, search

TARGET = np.array([0.2, 0.7, 1.0])


def bowl(points):
    return np.array([np.sum((point - TARGET) ** 2) for point in points])


def unknown(generations):
    return np.full((generations, 8), np.nan)


def test_it_finds_the_bottom_of_a_bowl_at_a_face_of_the_box():
    point, least = search(bowl, np.full(3, 0.5), 0.2, unknown(60), 0)
    np.testing.assert_allclose(point, TARGET, atol=0.01)
    assert least == pytest.approx(bowl([point])[0], abs=1e-6)


def test_known_losses_are_repeated_and_lead_to_the_same_end():
    calls, kept = [], []

    def counted(points):
        calls.append(len(points))
        return bowl(points)

    whole = search(counted, np.full(3, 0.5), 0.2, unknown(12), 3, lambda done, losses: kept.append(losses.copy()))
    assert len(calls) == 12
    calls.clear()
    resumed = search(counted, np.full(3, 0.5), 0.2, kept[6], 3)
    assert len(calls) == 5
    np.testing.assert_array_equal(resumed[0], whole[0])


def test_tanks_that_fail_are_the_worst_and_do_not_stop_it():
    def partly(points):
        return np.where([point[0] > 0.5 for point in points], np.nan, bowl(points))

    seen = []
    point, _ = search(partly, np.full(3, 0.5), 0.2, unknown(40), 0, lambda done, losses: seen.append(losses))
    np.testing.assert_allclose(point, TARGET, atol=0.05)
    assert (seen[-1] == FAILED).any()


def test_a_generation_without_a_single_tank_is_an_error():
    with pytest.raises(RunError, match="no tank of a generation has finite readings"):
        search(lambda points: np.full(len(points), np.nan), np.full(3, 0.5), 0.2, unknown(3), 0)
