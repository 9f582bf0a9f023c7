import numpy as np
import pytest

from softfin.storage.bag.zero import parse_zero, zero_event, zeros_at


@pytest.mark.parametrize("zero", [(0.0, 0.0), (-1.25, 0.0312), (499.9999, -500.0)])
def test_a_zero_is_read_as_it_was_recorded(zero):
    assert parse_zero(zero_event(zero)) == pytest.approx(zero, abs=1e-4)


@pytest.mark.parametrize(
    "words", ["inactive", "force at rest: (nan, 0.0000) N", f"{zero_event((1.0, 2.0))}; and more"]
)
def test_other_events_are_no_zeros(words):
    assert parse_zero(words) is None


def test_a_zero_holds_until_the_next_and_the_first_one_before_it_too():
    zeros = [(1.0, (0.1, -0.1)), (3.0, (0.2, -0.2))]
    assert zeros_at(zeros, np.array([0.0, 1.0, 2.9, 3.0, 9.0]))[:, 0].tolist() == [
        0.1,
        0.1,
        0.1,
        0.2,
        0.2,
    ]
    assert zeros_at([], np.array([0.0, 1.0])).tolist() == [[0.0, 0.0], [0.0, 0.0]]
