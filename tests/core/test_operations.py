"""Operations that differ between array libraries."""

import re

import jax
import numpy as np
import pytest

from softfin.core.operations import NUMPY, jax_operations
from tests.documents import ROOT

LAPACK = re.compile(r"(?:jnp|xp|jax\.numpy|jax\.scipy)\.linalg\.(?!norm\b|vector_norm\b)")


@pytest.mark.parametrize("size", [1, 2, 18])
def test_batches_of_systems_are_solved_as_with_numpy(size: int) -> None:
    random = np.random.default_rng(size)
    systems = random.normal(size=(40, size, size)).astype(np.float32)
    # The first pivot is 0, so rows have to be exchanged.
    systems[:, 0, 0] = 0 if size > 1 else 2
    right = random.normal(size=(40, size, 3)).astype(np.float32)
    solutions, logarithms = jax.jit(jax.vmap(jax_operations().solve))(systems, right)
    for system, each, solution, logarithm in zip(
        systems, right, solutions, logarithms, strict=True
    ):
        exact, expected = NUMPY.solve(system.astype(float), each.astype(float))
        np.testing.assert_allclose(system @ solution, each, atol=2e-3)
        np.testing.assert_allclose(solution, exact, rtol=2e-2, atol=2e-2)
        assert logarithm == pytest.approx(expected, abs=1e-3)


def test_no_compiled_program_waits_for_itself_in_lapack() -> None:
    """Two batched calls at the same time have stopped `softfin evaluate --feedback` for ever."""
    places = [
        f"{file.relative_to(ROOT)}: {line.strip()}"
        for file in sorted((ROOT / "src").glob("**/*.py"))
        for line in file.read_text().splitlines()
        if LAPACK.search(line)
    ]
    assert not places
