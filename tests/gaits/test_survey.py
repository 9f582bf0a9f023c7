"""The survey of a fin whose reach is known: 0.5 v (1 - cos stroke) N along the middle of each
stroke."""

import jax
import numpy as np

from softfin.core.action_clock import PAPER_CLOCK
from softfin.gaits.simulate import (
    AMPLITUDES,
    CENTRES,
    _middle,
    gait_families,
    strokes,
    survey,
)
from tests.gaits.mapped import FIN, SURVEY, simulate_gait, surveyed

MOST_N = np.pi
"""Straight ahead: strokes of 180 degrees at pi rad/s."""


def test_every_gait_was_tried_and_its_force_kept_beside_it() -> None:
    found = surveyed()
    assert found.force.shape == (9, 11, 7, 2)
    for place in ((0, 0, 3), (4, 8, 2), (8, 10, 6)):
        gait = strokes(
            *gait_families(PAPER_CLOCK)[place[0]],
            CENTRES[place[1] : place[1] + 1],
            AMPLITUDES[place[2] : place[2] + 1],
        )[0]
        alone = simulate_gait(FIN, gait, SURVEY.cycles, jax.random.key(0))
        np.testing.assert_allclose(found.force[place], alone.force, atol=1e-4)


def test_chunks_do_not_change_what_is_found() -> None:
    """100 does not divide the 693 gaits, so the last chunk is filled up."""
    other = survey(FIN, SURVEY.model_copy(update={"batch": 100}))
    np.testing.assert_allclose(other.force, surveyed().force, atol=1e-4)
    np.testing.assert_allclose(other.reachable.corners(), surveyed().reachable.corners(), atol=0.02)


def test_the_region_reaches_as_far_as_the_fin_and_no_farther() -> None:
    found = surveyed().reachable
    box = found.bounding_box()
    (x0, y0), (x1, y1) = box.low, box.high
    assert 0.95 * MOST_N < x1 <= MOST_N + 1e-3
    assert x0 > -0.01
    # The middle of a stroke of s is at most (pi - s) / 2 aside: most is 0.5 pi max_s (1 - cos s)
    # cos(s / 2).
    stroke = np.linspace(0, np.pi, 1000)
    aside = (0.5 * np.pi * (1 - np.cos(stroke)) * np.cos(stroke / 2)).max()
    np.testing.assert_allclose([-y0, y1], aside, rtol=0.12)
    assert y1 <= aside + 1e-3
    assert found.contains((2, 0))
    assert not found.contains((-0.2, 0))


def test_pushing_only_ever_widens_the_region() -> None:
    tried = survey(FIN, SURVEY.model_copy(update={"pushes": 0})).reachable
    pushed = surveyed().reachable
    np.testing.assert_array_equal(pushed.centre, tried.centre)
    assert (np.asarray(pushed.radius) >= np.asarray(tried.radius) - 1e-5).all()
    assert pushed.area() > tried.area()


def test_progress_rises_to_the_end() -> None:
    said: list[float] = []
    survey(FIN, SURVEY, lambda done, note: said.append(done))
    assert said == sorted(said)
    assert said[-1] == 1


def test_the_middle_is_seen_from_a_force_that_a_gait_makes_where_none_is_near_it() -> None:
    turn = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([np.cos(turn), 2 * np.sin(turn)], axis=1)
    np.testing.assert_allclose(np.abs(_middle(ring)), [1, 0], atol=0.06)
    filled = np.concatenate([ring, 0.1 * ring])
    np.testing.assert_allclose(_middle(filled), [0, 0], atol=1e-2)
