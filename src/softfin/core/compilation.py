"""`equinox.filter_jit` with XLA options, for programs that take longer to compile than to run, and
calls of compiled programs in threads."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Literal, TypeVar, cast

import equinox as eqx
import jax

Function = TypeVar("Function", bound=Callable[..., Any])
Item = TypeVar("Item")
Result = TypeVar("Result")
State = TypeVar("State")

OPTIMISATION_LEVELS = {"low": 1, "none": 0}
"""XLA's optimisation levels."""

# The older of XLA's two CPU code generators compiles a third faster. XLA rejects unknown options,
# so this is set only for versions of JAX that are known to have it.
OLDER_GENERATOR = (
    {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__[:2] == (0, 10) else {}
)


def jit(effort: Literal["low", "none"]) -> Callable[[Function], Function]:
    """Return a decorator that compiles with the given effort.

    Compared with `equinox.filter_jit` on two cores:
    - low: half the compile time; the virtual tank and the training of force networks run at the
      same speed, but force networks without a gradient are up to 1.5 times slower.
    - none: a third of the compile time; everything runs three times slower. For programs that run
      once.
    """
    has_no_optimisation = cast(Any, jax.config).read("jax_disable_most_optimizations")
    level = 0 if has_no_optimisation else OPTIMISATION_LEVELS[effort]
    options: dict[str, Any] = {**OLDER_GENERATOR, "xla_backend_optimization_level": level}

    return partial(cast(Any, eqx.filter_jit), compiler_options=options)


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the result for each item, computed in one thread per core.

    Use it for functions that spend their time in compiled programs, which run without Python's
    lock. Threads that call a new program at the same time wait for one compilation.
    """
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        return list(threads.map(function, items))


def chain_in_threads(
    function: Callable[[State, Item], State], starts: Sequence[State], items: Sequence[Item]
) -> Iterator[list[State]]:
    """Yield the states of all chains after each item; `function` returns a chain's next state.

    Chains run in one thread per core. A chain starts its next item while others are still on the
    previous one, so all cores are busy even if the number of chains is not a multiple of the number
    of cores.
    """

    def step(before: Future[State], item: Item) -> State:
        # Threads take steps in order, so the previous step has already started.
        return function(before.result(), item)

    threads = ThreadPoolExecutor(os.cpu_count())
    try:
        latest = [threads.submit(lambda state: state, start) for start in starts]
        rows = []
        for item in items:
            latest = [threads.submit(step, before, item) for before in latest]
            rows.append(latest)
        for row in rows:
            yield [future.result() for future in row]
    finally:
        threads.shutdown(cancel_futures=True)
