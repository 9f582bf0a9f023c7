import numpy as np
import pytest

from softfin.surrogate.metrics import DTW_BAND, dtw_scores, series_scores


def warped(a, b, band, cost):
    """The textbook's table: least sum of costs over monotone paths in the band, and the steps of that path."""
    best = {(-1, -1): (0.0, 0)}
    for i in range(len(a)):
        for j in range(max(0, i - band + 1), min(len(b), i + band)):
            before = [best[p] for p in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if p in best]
            least, steps = min(before)
            best[i, j] = (least + cost(a[i] - b[j]), steps + 1)
    return best[len(a) - 1, len(b) - 1]


@pytest.mark.parametrize("n", [30, 160])
def test_the_distances_are_those_of_their_definitions(n):
    random = np.random.default_rng(n)
    a, b = random.normal(size=(2, n)).cumsum(axis=1)
    (squared, steps), (absolute, _) = (warped(a, b, DTW_BAND, cost) for cost in (np.square, np.abs))
    scores = dtw_scores(a, b)
    assert steps > n
    assert scores["dtw_raw"] == pytest.approx(np.sqrt(squared))
    assert scores["dtw_path"] == pytest.approx(np.sqrt(squared) / steps)
    assert scores["dtw_rms"] == pytest.approx(np.sqrt(squared / n))
    assert scores["dtw_mae"] == pytest.approx(absolute / n)


def test_distances_scale_with_their_series():
    a, b = np.random.default_rng(0).normal(size=(2, 200)).cumsum(axis=1)
    for one, other in zip(dtw_scores(a, b).values(), dtw_scores(0.25 * a, 0.25 * b).values(), strict=True):
        assert other == pytest.approx(0.25 * one)


def test_equal_series_have_no_distance():
    series = np.sin(np.arange(50.0))[:, None]
    assert set(series_scores(series, series).values()) == {0.0}
