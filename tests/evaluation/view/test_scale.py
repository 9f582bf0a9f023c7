import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.evaluation.view.footage import choose_scale, max_sizes, round_down
from tests.evaluation.view.fins import LENGTH_M, BendingFin, beating


@given(st.floats(1e-6, 1e6))
def test_a_number_is_rounded_down_to_the_last_of_1_2_5(value):
    rounded = round_down(value)
    assert rounded <= value * (1 + 1e-9)
    assert rounded > value / 2.5 * (1 - 1e-9)
    assert f"{rounded:e}"[:8] in ("1.000000", "2.000000", "5.000000")


def test_the_greatest_are_those_of_force_and_reference_or_mean():
    footage = beating(BendingFin(), 220, reference=(20.0, -1.0))
    force = np.linalg.norm(footage.reading.force, axis=1).max()
    np.testing.assert_allclose(max_sizes(footage), [force, np.hypot(20, 1)], rtol=1e-6)


def test_the_scale_of_a_growing_footage_holds_every_shape_and_arrow():
    footage = beating(BendingFin(), 220, reference=(2.0, -1.0))
    scale = choose_scale(footage, max_sizes(footage) + 0.1, (-1.6, 1.6))
    assert scale.length_m == pytest.approx(LENGTH_M)
    arrows = [
        footage.reading.force * scale.metres_per_newton,
        footage.average * scale.metres_per_mean_newton,
    ]
    for points in (
        footage.shape.reshape(-1, 2),
        *arrows,
        footage.reference * scale.metres_per_mean_newton,
    ):
        assert (points.min(axis=0) >= (scale.x[0], scale.y[0])).all()
        assert (points.max(axis=0) <= (scale.x[1], scale.y[1])).all()
