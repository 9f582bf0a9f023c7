"""Errors over a controller's range: at random references, and at those of a lattice."""

import json

import jax
import numpy as np
import pytest

from softfin.core.errors import CoverageError
from softfin.core.randomness import named_generator
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.figures import error_map_figure
from softfin.evaluation.range_errors import draw_references, errors_at, map_errors, random_errors
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable
from softfin.task.references import PAPER_CELLS
from tests.evaluation.test_moving import Covering
from tests.plants import AnalyticFin

KEY = jax.random.key(0)
DISC = Reachable(np.float32([2, 0]), np.full(64, 1.0, np.float32))


def within(cells_, reachable_=None):
    class Within(Covering):
        cells: tuple[Cell, ...] = cells_
        reachable: Reachable | None = reachable_

    return Within()


def test_they_lie_in_a_cell_and_in_reach_and_are_spread_by_area():
    cells = (Cell(low=(1, -1), high=(2, 1)), Cell(low=(2, 0), high=(3, 1)))
    forces = draw_references(within(cells, DISC), 3000, named_generator(0, "test"))
    assert forces.shape == (3000, 2)
    assert DISC.contains(forces).all()
    assert all(min(cell.distance((x, y)) for cell in cells) == 0 for x, y in forces.tolist())
    # Three quarters of a disc, two of them in the first cell.
    assert np.mean(forces[:, 0] < 2) == pytest.approx(2 / 3, abs=0.03)


def test_the_seed_says_which():
    one, same, other = (
        draw_references(within(PAPER_CELLS), 5, named_generator(seed, "test")) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).all()


def test_cells_beyond_reach_are_refused():
    with pytest.raises(
        CoverageError, match=r"random = 3: this fin can reach only 0 of 300 references .*; train"
    ):
        draw_references(
            within((Cell(low=(5, 5), high=(6, 6)),), DISC), 3, named_generator(0, "test")
        )


def test_the_errors_have_mean_percentile_and_worst():
    row = random_errors(Covering(), AnalyticFin(noise_n=0), 20, 0, 3, KEY)
    references = np.array(row["references_n"])
    assert references.shape == (20, 2)
    alone = errors_at(Covering(), AnalyticFin(noise_n=0), references, 3, KEY)
    np.testing.assert_allclose(row["errors_n"], alone, atol=1e-3)
    for i in range(2):
        assert row["worst_n"][i] == pytest.approx(alone[:, i].max(), abs=1e-3)
        assert row["mean_n"][i] < row["p95_n"][i] < row["worst_n"][i]
    json.dumps(row, allow_nan=False)


@pytest.fixture(scope="module")
def errors():
    return map_errors(Covering(), AnalyticFin(), 6, 3, KEY)


def test_the_lattice_is_laid_over_the_range_and_leaves_out_what_is_not_covered(errors):
    # Six of the nine squares of 1 N are covered, each with four of the 36 references.
    assert errors.references.shape == errors.error.shape == (24, 2)
    assert errors.to_dict()["not_covered"] == 12
    np.testing.assert_allclose(errors.references[0], [0.75, -1.25])
    assert errors.to_dict()["low_n"] == [0.5, -1.5]


def test_each_error_is_that_of_its_reference_alone(errors):
    config = EvaluateConfig(references=(tuple(errors.references[7].tolist()),), seconds=3)
    alone = score_controller(Covering(), AnalyticFin(noise_n=0), config)
    quiet = errors_at(Covering(), AnalyticFin(noise_n=0), errors.references, 3, KEY)
    np.testing.assert_allclose(quiet[7], alone.scores.error[0, 0], atol=1e-5)


def test_tiles_stand_at_their_references(errors):
    left, right = error_map_figure(errors).get_axes()[:2]
    for index, axes in enumerate((left, right)):
        (image,) = axes.get_images()
        x0, x1, y0, y1 = image.get_extent()
        for (x, y), error in zip(errors.references, errors.error[:, index], strict=True):
            column = int((x - x0) / (x1 - x0) * 6)
            row = int((y - y0) / (y1 - y0) * 6)
            assert image.get_array()[row, column] == pytest.approx(error)
        assert np.ma.count_masked(np.ma.masked_invalid(image.get_array())) == 12
    assert left.get_images()[0].get_clim() == right.get_images()[0].get_clim()


def test_the_papers_references_are_marked_and_reachable_forces_outlined(errors):
    corners = np.array([[0.0, -1.0], [3.0, -1.0], [3.0, 1.0]])
    marks, outline = error_map_figure(errors._replace(reachable=corners)).get_axes()[0].get_lines()
    assert set(zip(*marks.get_data(), strict=True)) == set(PAPER_REFERENCES)
    np.testing.assert_array_equal(outline.get_xydata(), [*corners, corners[0]])
    assert len(error_map_figure(errors).get_axes()[0].get_lines()) == 1


def test_a_small_fin_has_no_references_of_the_paper(errors):
    small = errors._replace(
        cell=Cell(low=(0.025, -0.075), high=(0.175, 0.075)),
        references=0.05 * errors.references,
        error=0.05 * errors.error,
    )
    axes = error_map_figure(small).get_axes()[0]
    assert axes.get_lines()[:] == []
    assert axes.get_xlim() == (0.025, 0.175)


def test_the_map_takes_the_reachable_forces_from_the_controller():
    class Knowing(Covering):
        reachable: Reachable = Reachable(np.float32([2, 0]), np.full(8, 1.2, np.float32))

    errors = map_errors(Knowing(), AnalyticFin(), 2, 3, KEY)
    np.testing.assert_allclose(errors.reachable[[0, 2]], [[3.2, 0], [2, 1.2]], atol=1e-6)


def test_what_the_fin_cannot_make_is_counted_and_not_scored():
    class Weak(Covering):
        cells: tuple[Cell, ...] = (Cell(low=(0, 0), high=(2, 2)),)
        reachable: Reachable = Reachable(np.float32([0, 0]), np.full(64, 1.0, np.float32))

    values = map_errors(Weak(), AnalyticFin(), 2, 3, KEY).to_dict()
    assert values["references_n"] == [[0.5, 0.5]]
    assert (values["not_covered"], values["not_reachable"]) == (0, 3)


def test_a_range_without_area_has_no_map():
    class Single(Covering):
        cells: tuple[Cell, ...] = (Cell(low=(1, 0), high=(2, 0)),)

    with pytest.raises(CoverageError, match="range has no area; train it for a larger cell"):
        map_errors(Single(), AnalyticFin(), 6, 3, KEY)
