import numpy as np
import pytest

from softfin.evaluation.view.picture import PIECES, arrow_outline, fin_outline, smooth


def area(polygon):
    x, y = polygon.T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2


def test_the_smooth_line_goes_through_every_point():
    points = np.array([[0.0, 0.0], [1.0, 0.2], [2.0, 0.9], [2.5, 2.0]])
    line = smooth(points)
    np.testing.assert_allclose(line[::PIECES], points)
    assert len(line) == 3 * PIECES + 1


def test_the_smooth_line_of_a_circle_stays_near_it():
    turn = np.linspace(0, 1.2, 9)
    line = smooth(np.stack([np.cos(turn), np.sin(turn)], axis=1))
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 1, atol=2e-3)


def test_a_straight_fin_has_the_area_of_a_trapezium_with_a_round_tip():
    points = np.stack([np.linspace(0, -0.2, 9), np.zeros(9)], axis=1)
    outline = fin_outline(points, np.linspace(0.02, 0.01, 9))
    assert area(outline) == pytest.approx(0.2 * 0.015 + np.pi * 0.005**2 / 2, rel=1e-2)
    assert outline[:, 0].min() == pytest.approx(-0.205, abs=1e-4)


def test_an_arrow_ends_at_its_vector_and_vanishes_with_it():
    vector = np.array([0.03, 0.04])
    outline = arrow_outline(vector, 0.005)
    np.testing.assert_allclose(outline[np.linalg.norm(outline, axis=1).argmax()], vector)
    np.testing.assert_allclose(arrow_outline(np.zeros(2), 0.005), 0)
