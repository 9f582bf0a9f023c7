"""Gaits for a lattice of forces: found in a fin of strokes, and blended between the nodes."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from examples.import_keras import read_keras_surrogate
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.gaits import search
from softfin.gaits import simulate as survey_module
from softfin.gaits.gait import GaitTable
from softfin.gaits.reachable import Cell
from softfin.gaits.search import GaitConfig, find_gaits
from softfin.gaits.simulate import SurveyConfig, gait_families, survey
from softfin.gaits.simulate import simulate_gait as simulate
from tests.gaits.mapped import FIN, GAITS, mapped, simulate_gait, surveyed
from tests.plants import StrokeFin

KEY = jax.random.key(0)
RANDOM = GaitTable(
    jnp.array([0.5, -1]),
    jnp.array([2.5, 2]),
    jax.random.uniform(KEY, (3, 4, 6, 2), minval=-1, maxval=1),
)
"""Nodes 1 N apart."""
LATTICE = GaitTable.empty((0.5, -0.5), (1.5, 0.5), (3, 3))

blended = jax.jit(lambda table, x, y: table.gait(jnp.stack([x, y])))


def test_every_node_makes_its_force() -> None:
    found = mapped().gaits
    assert found.table.actions.shape == (3, 3, 6, 2)
    assert np.abs(found.table.actions).max() <= 1
    assert found.force_error().max() < 0.01


def test_what_a_node_is_said_to_make_is_what_its_gait_makes() -> None:
    found = mapped().gaits
    for node in ((0, 0), (1, 2), (2, 1)):
        alone = simulate_gait(FIN, found.table.actions[node], GAITS.cycles, KEY)
        np.testing.assert_allclose(found.force[node], alone.force, atol=1e-4)
        np.testing.assert_allclose(found.smoothness[node], alone.smoothness, atol=1e-4)


def test_beyond_reach_a_node_makes_the_nearest_force_that_the_fin_can_make() -> None:
    """-x is beyond any fin that only pushes; the other end of the lattice is within reach."""
    found = find_gaits(FIN, surveyed(), GaitTable.empty((-1, 0), (1.5, 0.25), (2, 2)), GAITS)
    np.testing.assert_allclose(found.force[0, 0], (0, 0), atol=0.1)
    assert found.force_error()[0, 0] == pytest.approx(1, abs=0.1)
    assert found.force_error()[1].max() < 0.01


def test_a_fin_without_any_choice_leaves_its_nodes_where_they_are() -> None:
    """Nothing that a fin without thrust does changes its force: no slope, no step, and no number
    that is none."""
    still = StrokeFin(gain=0.0, bias=(0.3, 0.0))
    few = SurveyConfig(cycles=2, batch=256, directions=8, pushes=1)
    found = find_gaits(
        still,
        survey(still, few),
        GaitTable.empty((0, 0), (1, 1), (2, 2)),
        GaitConfig(cycles=2, steps=7, halvings=0),
    )
    np.testing.assert_allclose(found.force, np.broadcast_to([0.3, 0], (2, 2, 2)), atol=1e-5)
    assert np.isfinite(found.table.actions).all()


def from_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The survey's strokes are smooth and alike already."""
    start = jax.random.normal(KEY, (9, 12)) / 2
    monkeypatch.setattr(search, "_start", lambda *_: start)


def test_smoothness_lowers_the_sobolev_term_of_gaits_that_make_the_same_forces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from_anywhere(monkeypatch)
    rough, smooth = (
        find_gaits(
            FIN,
            surveyed(),
            LATTICE,
            GAITS.model_copy(update={"likeness": 0.0, "smoothness": weight}),
        )
        for weight in (0.0, 1.0)
    )
    assert smooth.force_error().mean() < 0.05
    assert smooth.smoothness.sum() < 0.9 * rough.smoothness.sum()


def test_likeness_brings_the_gaits_of_neighbours_together(monkeypatch: pytest.MonkeyPatch) -> None:
    from_anywhere(monkeypatch)
    apart, alike = (
        np.abs(np.diff(find_gaits(FIN, surveyed(), LATTICE, config).table.actions, axis=0)).mean()
        for config in (GAITS.model_copy(update={"likeness": weight}) for weight in (0.0, 0.6))
    )
    assert alike < 0.8 * apart


def test_halving_the_spacing_leaves_less_between_the_nodes() -> None:
    places = np.random.default_rng(0).uniform((0.5, -0.5), (1.5, 0.5), (20, 2)).astype(np.float32)
    coarse, fine = (
        find_gaits(FIN, surveyed(), LATTICE, GAITS.model_copy(update={"halvings": count}))
        for count in (0, 1)
    )
    assert fine.table.nodes == (5, 5)
    np.testing.assert_array_equal(fine.table.actions[::2, ::2], coarse.table.actions)
    assert fine.force_error().max() < 0.01
    left = [
        np.mean(
            [
                np.abs(simulate_gait(FIN, found.table.gait(place), 2, KEY).force - place)
                for place in places
            ]
        )
        for found in (coarse, fine)
    ]
    assert left[1] < 0.5 * left[0]


def test_a_lattice_has_the_corners_of_the_box_and_no_wider_spacing() -> None:
    box = Cell(low=(0.5, -1.5), high=(3.5, 1.2))
    lattice = GaitTable.over(box, 0.5)
    assert lattice.nodes == (7, 7)
    nodes = lattice.references()
    np.testing.assert_allclose([nodes[0, 0], nodes[-1, -1]], [box.low, box.high], atol=1e-6)
    np.testing.assert_allclose(np.diff(nodes[:, 0, 0]), 0.5, atol=1e-6)
    np.testing.assert_allclose(np.diff(nodes[0, :, 1]), 0.45, atol=1e-6)
    assert GaitTable.over(box, 99.0).nodes == (2, 2)


@given(st.floats(0.1, 5), st.floats(0.1, 5), st.floats(0.05, 2))
def test_nodes_are_as_few_as_the_spacing_allows(
    width: float, height: float, spacing: float
) -> None:
    lattice = GaitTable.over(Cell(low=(0, 0), high=(width, height)), spacing)
    for length, count in zip((width, height), lattice.nodes, strict=True):
        assert length / (count - 1) <= spacing * (1 + 1e-4)
        assert count == 2 or length / (count - 2) > spacing * (1 - 1e-4)


def test_at_a_node_the_blend_is_its_gait() -> None:
    for i, j in np.ndindex(3, 4):
        np.testing.assert_allclose(
            blended(RANDOM, 0.5 + i, -1.0 + j), RANDOM.actions[i, j], atol=1e-5
        )


@given(st.integers(0, 1), st.integers(0, 2), st.floats(0, 1), st.floats(0, 1))
@settings(deadline=None)
def test_between_nodes_it_is_linear_along_each_axis(i: int, j: int, x: float, y: float) -> None:
    a, b, c, d = (RANDOM.actions[i + p, j + q] for p, q in ((0, 0), (1, 0), (0, 1), (1, 1)))
    expected = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
    np.testing.assert_allclose(blended(RANDOM, 0.5 + i + x, -1 + j + y), expected, atol=1e-4)


def test_beyond_the_lattice_it_is_the_gait_of_the_edge() -> None:
    np.testing.assert_allclose(blended(RANDOM, 9.0, 9.0), RANDOM.actions[-1, -1], atol=1e-5)
    np.testing.assert_allclose(blended(RANDOM, -9.0, 0.0), RANDOM.actions[0, 1], atol=1e-5)


def test_a_lattice_for_a_single_force_has_its_gait() -> None:
    """A cell may be one reference; its lattice has no width."""
    table = GaitTable.over(Cell(low=(1, 0), high=(1, 0)), 0.5)._replace(
        actions=RANDOM.actions[:2, :2]
    )
    assert np.isfinite(blended(table, 1.0, 0.0)).all()


@pytest.mark.slow
def test_a_gait_of_the_published_fin_holds_its_force_in_the_steady_state(
    published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two families of strokes, so that the search is short."""
    for module in (survey_module, search):
        monkeypatch.setattr(module, "gait_families", lambda *clock: gait_families(*clock)[:2])
    monkeypatch.setattr(survey_module, "SIDE_BY_SIDE", 4)
    fin = read_keras_surrogate(
        published / "cnn_pos_net.keras",
        published / "lstm_force_net.keras",
        published / "scalers.json",
    )
    surveyed = survey(fin, SurveyConfig(cycles=2, directions=8, pushes=0))
    lattice = GaitTable.empty((1.5, -0.25), (2, 0), (2, 2))
    found = find_gaits(fin, surveyed, lattice, GaitConfig(cycles=2, steps=8, halvings=0))
    response = jax.jit(lambda gait: simulate(fin, gait, 4, KEY))(
        found.table.gait(jnp.array([2.0, 0.0]))
    )
    np.testing.assert_allclose(response.force, (2, 0), atol=0.02)
