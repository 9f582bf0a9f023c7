from pathlib import Path

import numpy as np

import softfin
from softfin.core.randomness import cma_es, named_generator


def searched(seed):
    search = cma_es(np.full(3, 0.5), 0.2, np.random.default_rng(seed), popsize=8, maxiter=4)
    points = []
    while not search.stop():
        points.append(np.stack(search.ask()))
        search.tell(list(points[-1]), (points[-1] ** 2).sum(axis=1).tolist())
    return np.stack(points)


def test_every_whole_number_is_a_seed():
    numbers = [named_generator(seed, "a").integers(2**62) for seed in (-1, 2**32 - 1, 2**40, 0, 1)]
    assert numbers[0] == numbers[1]
    assert numbers[2] == numbers[3] != numbers[4]


def global_state():
    name, *rest = np.random.get_state()  # noqa: NPY002
    return [name, *map(np.ndarray.tolist, map(np.asarray, rest))]


def test_numpys_global_generator_is_neither_read_nor_written():
    np.random.seed(5)  # noqa: NPY002
    before = global_state()
    one = searched(0)
    assert global_state() == before
    np.random.seed(6)  # noqa: NPY002
    np.testing.assert_array_equal(searched(0), one)
    assert not np.array_equal(searched(1), one)


def test_a_file_in_the_working_directory_gives_no_orders(tmp_path, monkeypatch):
    one = searched(0)
    (tmp_path / "cma_signals.in").write_text("{'maxiter': 1}")
    monkeypatch.chdir(tmp_path)
    np.testing.assert_array_equal(searched(0), one)


def test_every_search_goes_through_it():
    """The library by itself reseeds the whole process."""
    sources = Path(softfin.__file__).parent.rglob("*.py")
    users = [path.name for path in sources if "import cma\n" in path.read_text()]
    assert users == ["randomness.py"]
