import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.evaluation.view.scale import Greatest, round_up
from tests.evaluation.view.fins import LENGTH_M, BendingFin, beating


@given(st.floats(1e-6, 1e6))
def test_a_number_is_rounded_up_to_the_next_of_1_2_5(value):
    rounded = round_up(value)
    assert value <= rounded * (1 + 1e-9)
    assert rounded < 2.5 * value * (1 + 1e-9)
    assert f"{rounded:e}"[:8] in ("1.000000", "2.000000", "5.000000")


def test_room_grows_with_the_footage_and_never_shrinks():
    footage = beating(BendingFin(), 220, reference=(2.0, -1.0))
    had = Greatest(force_n=1.0, mean_n=50.0, stream_m_s=0.05)
    room = had.including(footage)
    greatest = np.linalg.norm(footage.reading.force, axis=1).max()
    assert greatest <= room.force_n < 2.5 * greatest
    assert (room.mean_n, room.stream_m_s) == (50.0, 0.05)
    assert room.including(footage) == room


def test_the_scale_of_a_growing_footage_holds_every_shape_and_arrow():
    footage = beating(BendingFin(), 220, reference=(2.0, -1.0))
    scale = Greatest(0.1, 0.1, 0.1).including(footage).scale(footage.length_m, (-1.6, 1.6))
    assert scale.length_m == pytest.approx(LENGTH_M)
    arrows = [footage.reading.force * scale.metres_per_newton, footage.average * scale.metres_per_mean_newton]
    for points in (footage.shape.reshape(-1, 2), *arrows, footage.reference * scale.metres_per_mean_newton):
        assert (points.min(axis=0) >= (scale.x[0], scale.y[0])).all()
        assert (points.max(axis=0) <= (scale.x[1], scale.y[1])).all()
