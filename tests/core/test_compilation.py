import threading

import jax.numpy as jnp
import pytest

from softfin.core.compilation import chain_in_threads, jit, map_in_threads

PATIENCE_S = 60


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)


def test_results_of_threads_are_in_the_order_of_the_items():
    second_is_done = threading.Event()

    def finish_last_first(item):
        if item == 0:
            assert second_is_done.wait(PATIENCE_S)
        else:
            second_is_done.set()
        return 10 * item

    assert map_in_threads(finish_last_first, range(2)) == [0, 10]


def test_an_error_in_a_thread_reaches_the_caller():
    def fail(item):
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item 0"):
        map_in_threads(fail, range(3))


def test_a_chain_starts_its_next_item_before_all_others_have_finished_the_one_before():
    first_chain_is_at_its_second_item = threading.Event()

    def append(chain, item):
        name, items = chain
        if (name, item) == ("a", 1):
            first_chain_is_at_its_second_item.set()
        if (name, item) == ("c", 0):
            assert first_chain_is_at_its_second_item.wait(PATIENCE_S)
        return name, [*items, item]

    *_, last = chain_in_threads(append, [("a", []), ("b", []), ("c", [])], range(2))
    assert last == [("a", [0, 1]), ("b", [0, 1]), ("c", [0, 1])]


def test_states_of_chains_are_yielded_after_each_item():
    after = list(chain_in_threads(lambda total, item: total + item, [0, 10], [1, 2]))
    assert after == [[1, 11], [3, 13]]


def test_chains_end_when_their_caller_does():
    started = []

    def count(chain, item):
        started.append(item)
        return chain

    chains = chain_in_threads(count, [0], range(100_000))
    next(chains)
    chains.close()
    assert len(started) < 100_000


def test_threads_that_call_a_new_program_at_once_compile_it_once():
    traced = []
    meeting = threading.Barrier(2)

    @jit("none")
    def double(x):
        traced.append(x)
        return 2 * x

    def call(item):
        meeting.wait(PATIENCE_S)
        return float(double(jnp.float32(item)))

    assert map_in_threads(call, range(2)) == [0, 2]
    assert len(traced) == 1
