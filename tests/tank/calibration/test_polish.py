import numpy as np

from softfin.tank.calibration.polish import linearised, polish, weights_of

EVEN = weights_of([1.0])


class Valley:
    """Rosenbrock's valley in the place of tanks: residuals (1 - x, 10 (y - x^2)), with x and y running from -1 to 2."""

    def errors(self, points):
        for point in points:
            x, y = 3 * point - 1
            yield np.array([[[1 - x], [10 * (y - x**2)]]], np.float32)

    def misfits(self, points):
        return np.stack([np.mean(np.square(error, dtype=np.float64), axis=(0, 1)) for error in self.errors(points)])


class Steep(Valley):
    """Nothing finite but near the start."""

    def errors(self, points):
        for point, error in zip(points, super().errors(points), strict=True):
            yield error if np.abs(point - 0.2).max() < 0.01 else error * np.nan


def test_it_follows_a_bent_valley_to_its_end():
    linear = polish(Valley(), np.array([0.1, 0.9]), EVEN, 50)
    np.testing.assert_allclose(linear.point, [2 / 3, 2 / 3], atol=1e-3)
    assert linear.loss < 1e-6


def test_the_jacobian_is_that_of_the_residuals():
    linear = linearised(Valley(), np.array([0.5, 0.4]), EVEN)
    x = 0.5
    expected = np.array([[-3.0, -60.0 * x], [0.0, 30.0]]) / np.sqrt(2)
    np.testing.assert_allclose(linear.jacobian[:, 0, :, 0], expected, rtol=1e-3, atol=1e-3)
    _, gradient = linear.normal()
    np.testing.assert_allclose(gradient, expected @ linear.residuals.reshape(-1), rtol=1e-3, atol=1e-3)


def test_at_a_face_of_the_box_differences_are_one_sided():
    linear = linearised(Valley(), np.array([0.0, 1.0]), EVEN)
    np.testing.assert_allclose(linear.jacobian[1, 0, :, 0], [0.0, 30 / np.sqrt(2)], rtol=1e-3)


def test_steps_that_end_in_failure_are_shortened():
    seen = []
    linear = polish(Steep(), np.array([0.2, 0.2]), EVEN, 12, lambda iteration, loss: seen.append(loss))
    assert seen[-1] < linearised(Valley(), np.array([0.2, 0.2]), EVEN).loss
    assert np.isfinite(linear.loss)
    assert np.abs(linear.point - 0.2).max() < 0.01


def test_weights_sum_to_one():
    np.testing.assert_allclose(weights_of([1.0, 3.0]), [0.25, 0.75])
