import numpy as np
import pytest

from softfin.core.errors import RunError
from softfin.tank.calibration.search import FAILED, linearised, polish, search

TARGET = np.array([0.2, 0.7, 1.0])


def bowl(points):
    return np.array([np.sum((point - TARGET) ** 2) for point in points])


def unknown(generations):
    return np.full((generations, 8), np.nan)


def test_it_finds_the_bottom_of_a_bowl_at_a_face_of_the_box():
    point = search(bowl, np.full(3, 0.5), 0.2, unknown(60), 0)
    np.testing.assert_allclose(point, TARGET, atol=0.01)


def test_known_losses_are_repeated_and_lead_to_the_same_end():
    calls = []
    kept = []

    def counted(points):
        calls.append(len(points))
        return bowl(points)

    whole = search(
        counted,
        np.full(3, 0.5),
        0.2,
        unknown(12),
        3,
        lambda done, losses: kept.append(losses.copy()),
    )
    assert len(calls) == 12
    calls.clear()
    resumed = search(counted, np.full(3, 0.5), 0.2, kept[6], 3)
    assert len(calls) == 5
    np.testing.assert_array_equal(resumed, whole)


def test_tanks_that_fail_are_the_worst_and_do_not_stop_it():
    def partly(points):
        return np.where([point[0] > 0.5 for point in points], np.nan, bowl(points))

    seen = []
    point = search(
        partly, np.full(3, 0.5), 0.2, unknown(40), 0, lambda done, losses: seen.append(losses)
    )
    np.testing.assert_allclose(point, TARGET, atol=0.05)
    assert (seen[-1] == FAILED).any()


def test_a_generation_without_a_single_tank_is_an_error():
    with pytest.raises(RunError, match="no tank in this generation produced finite readings"):
        search(lambda points: np.full(len(points), np.nan), np.full(3, 0.5), 0.2, unknown(3), 0)


def valley(points):
    """Rosenbrock's valley in the place of tanks: residuals (1 - x, 10 (y - x^2)), with x and y
    running from -1 to 2."""
    for point in points:
        x, y = 3 * point - 1
        yield np.array([[[1 - x], [10 * (y - x**2)]]], np.float32)


def steep(points):
    """Yield nothing finite but near the start."""
    for point, error in zip(points, valley(points), strict=True):
        yield error if np.abs(point - 0.2).max() < 0.01 else error * np.nan


def test_it_follows_a_bent_valley_to_its_end():
    linear = polish(valley, np.array([0.1, 0.9]), 50)
    np.testing.assert_allclose(linear.point, [2 / 3, 2 / 3], atol=1e-3)
    assert linear.loss < 1e-6


def test_the_jacobian_is_that_of_the_residuals():
    linear = linearised(valley, np.array([0.5, 0.4]))
    x = 0.5
    expected = np.array([[-3.0, -60.0 * x], [0.0, 30.0]]) / np.sqrt(2)
    np.testing.assert_allclose(linear.jacobian[:, 0, :, 0], expected, rtol=1e-3, atol=1e-3)
    _, gradient = linear.normal()
    np.testing.assert_allclose(
        gradient, expected @ linear.residuals.reshape(-1), rtol=1e-3, atol=1e-3
    )


def test_at_a_face_of_the_box_differences_are_one_sided():
    linear = linearised(valley, np.array([0.0, 1.0]))
    np.testing.assert_allclose(linear.jacobian[1, 0, :, 0], [0.0, 30 / np.sqrt(2)], rtol=1e-3)


def test_steps_that_end_in_failure_are_shortened():
    seen = []
    linear = polish(steep, np.array([0.2, 0.2]), 12, lambda iteration, loss: seen.append(loss))
    assert seen[-1] < linearised(valley, np.array([0.2, 0.2])).loss
    assert np.isfinite(linear.loss)
    assert np.abs(linear.point - 0.2).max() < 0.01
