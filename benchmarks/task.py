"""Task steps a second in the published surrogate, no learning, against the machine's matrix-product
rate.

The same without what makes it quick: one fin after another instead of a batch, and tick by tick
instead of the surrogate's own program for a whole action.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from benchmarks.flops import flops_per_tick
from benchmarks.measure import entry, interleaved, matmul
from benchmarks.nets import published_layout
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.plant import State
from softfin.core.quantities import Command, Limits, Reading
from softfin.surrogate import Surrogate
from softfin.task.references import PAPER_RANGE, References
from softfin.task.task import ForceTracking, TaskConfig

TICKS = sum(PAPER_CLOCK.ticks)
BATCHES = (1, 4, 16, 64, 256)


class TickByTick(eqx.Module):
    """A surrogate that is advanced a tick at a time."""

    surrogate: Surrogate

    @property
    def limits(self) -> Limits:
        return self.surrogate.limits

    def init(self, key: PRNGKeyArray) -> State:
        return self.surrogate.init(key)

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        return self.surrogate.advance(state, command, ticks)


def steps(task: ForceTracking, batch: int, cycles: int) -> Callable[[], Any]:
    """A call that plays `cycles` cycles of three actions in `batch` environments."""
    keys = jax.random.split(jax.random.key(1), batch)
    state = jax.vmap(task.reset, (0, None))(keys, References.of(PAPER_RANGE))
    actions = jax.random.uniform(
        jax.random.key(2), (len(PAPER_CLOCK.ticks) * cycles, batch, 2), minval=-1, maxval=1
    )

    def act(state: Any, now: Any) -> Any:
        action, ticks = now
        state, outcome = jax.vmap(partial(task.step, ticks=ticks))(state, action)
        return state, outcome.reward

    program = jax.jit(
        lambda state, actions: jax.lax.scan(
            act, state, (actions, jnp.asarray(PAPER_CLOCK.action_ticks(len(actions))))
        )[1]
    )
    return lambda: program(state, actions)


def main() -> list[dict[str, Any]]:
    surrogate = published_layout()
    task = ForceTracking(surrogate, TaskConfig())
    slow = ForceTracking(TickByTick(surrogate), TaskConfig())
    product, flops = matmul()
    cycles = {batch: max(2, min(100, 1280 // batch)) for batch in BATCHES}
    calls = [steps(task, batch, count) for batch, count in cycles.items()]
    *times, by_tick, square = interleaved([*calls, steps(slow, 64, cycles[64]), product])
    rates = {
        batch: 3 * cycles[batch] * batch / each for batch, each in zip(BATCHES, times, strict=True)
    }
    rate = flops / square
    achieved = rates[64] / 3 * TICKS * flops_per_tick(surrogate)
    details = {"flops_per_tick": flops_per_tick(surrogate), "matmul_gflop_s": rate / 1e9}
    per_action = {"ticks_per_action": TICKS / 3}
    of_batches = {f"batch_{batch}_actions_per_s": value for batch, value in rates.items()}
    return [
        entry("task steps/s, batch 64", rates[64], "actions/s", 5000, **per_action),
        entry(
            "task, batch 64, share of the matmul rate",
            achieved / rate,
            "-",
            0.7,
            achieved_gflop_s=achieved / 1e9,
            **details,
        ),
        entry("task steps/s, batch 1", rates[1], "actions/s", 2000, **per_action),
        entry(
            "task, batch 64 / one fin after another", rates[64] / rates[1], "ratio", 1, **of_batches
        ),
        entry(
            "task, batch 64, whole actions / tick by tick",
            by_tick * rates[64] / (3 * cycles[64] * 64),
            "ratio",
            1,
        ),
    ]
