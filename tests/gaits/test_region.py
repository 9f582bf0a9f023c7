"""What is admitted without JAX is what is admitted with it."""

import numpy as np
import pytest

from softfin.control.range import admitted as originally_admitted
from softfin.core.errors import CoverageError
from softfin.gaits.reachable import Reachable
from softfin.gaits.region import Box, Region, admitted
from softfin.task.references import PAPER_CELLS, Cell
from tests.control.test_range import BOX, DISC, Holder

EGG = Reachable(np.float32([1.4, 0.1]), np.float32(1.1 + 0.6 * np.cos(np.linspace(0, 2 * np.pi, 32, endpoint=False))))
LINE = Cell(low=(0, 0.5), high=(5, 0.5))
AWAY = Cell(low=(7, 7), high=(8, 8))


def region_of(reachable: Reachable) -> Region:
    x, y = reachable.centre.tolist()
    return Region.of((x, y), reachable.radius.tolist())


def outcome(ask):
    """What a refusal says, or what is held and the warning."""
    try:
        return None, *ask()
    except CoverageError as error:
        return str(error), None, None


@pytest.mark.parametrize("reachable", [DISC, EGG, None], ids=["disc", "egg", "unknown"])
@pytest.mark.parametrize("cells", [(BOX,), PAPER_CELLS, (LINE,), (AWAY,)], ids=["box", "paper", "line", "away"])
@pytest.mark.parametrize("strict", [False, True])
def test_it_is_admitted_and_refused_as_the_trained_one_does(reachable, cells, strict):
    boxes = tuple(Box(tuple(map(float, cell.low)), tuple(map(float, cell.high))) for cell in cells)
    region = None if reachable is None else region_of(reachable)
    numbers = np.random.default_rng(0).uniform((-0.5, -2.2), (3.8, 2.2), (15, 2)).round(3).tolist()
    for asked in [*numbers, [1.0, 0.5], [1.4, 0.1], [2.0, 0.0], [9.0, 9.0]]:
        reference = (float(asked[0]), float(asked[1]))
        expected, held, warned = outcome(lambda at=reference: originally_admitted(Holder(reachable, cells), at, strict))
        refused, own, said = outcome(lambda at=reference: admitted(boxes, region, at, strict))
        assert refused == expected
        assert own == pytest.approx(held, abs=2e-4)
        assert (said is None) == (warned is None)


def test_going_to_the_centre_is_as_the_trained_one_does():
    for asked in np.random.default_rng(1).uniform(-4, 6, (40, 2)).astype(np.float32):
        expected = EGG.pulled(asked)
        assert region_of(EGG).pulled(tuple(asked.tolist())) == pytest.approx(tuple(expected.tolist()), abs=1e-5)


def test_what_is_no_force_is_refused():
    with pytest.raises(CoverageError, match=r"\(nan, 0\) N: give two finite numbers"):
        admitted((Box((0.0, 0.0), (1.0, 1.0)),), None, (float("nan"), 0.0), False)
