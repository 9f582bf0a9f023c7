"""Task steps a second in the published surrogate, no learning, against the machine's matrix-product rate."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.measure import entry, interleaved, matmul
from benchmarks.nets import published_layout
from softfin.core.action_clock import ACTION_TICKS, ticks_of
from softfin.task.references import PAPER_RANGE, References
from softfin.task.task import ForceTracking, TaskConfig

TICKS = sum(ACTION_TICKS)


def steps(task: ForceTracking, batch: int, cycles: int) -> Callable[[], Any]:
    """A call that plays `cycles` cycles of three actions in `batch` environments."""
    keys = jax.random.split(jax.random.key(1), batch)
    state = jax.vmap(task.reset, (0, None))(keys, References.of(PAPER_RANGE))
    actions = jax.random.uniform(jax.random.key(2), (len(ACTION_TICKS) * cycles, batch, 2), minval=-1, maxval=1)

    def act(state: Any, now: Any) -> Any:
        action, ticks = now
        state, outcome = jax.vmap(partial(task.step, ticks=ticks))(state, action)
        return state, outcome.reward

    program = jax.jit(
        lambda state, actions: jax.lax.scan(act, state, (actions, jnp.asarray(ticks_of(len(actions)))))[1]
    )
    return lambda: program(state, actions)


def main() -> list[dict[str, Any]]:
    surrogate = published_layout()
    task = ForceTracking(surrogate, TaskConfig())
    product, flops = matmul()
    large, small = 20, 100
    sixty_four, one, square = interleaved([steps(task, 64, large), steps(task, 1, small), product])
    rate, many = flops / square, 64 * large
    achieved = many * TICKS * surrogate.flops_per_tick() / sixty_four
    details = {"flops_per_tick": surrogate.flops_per_tick(), "matmul_gflop_s": rate / 1e9}
    per_action = {"ticks_per_action": TICKS / 3}
    return [
        entry("task steps/s, batch 64", 3 * many / sixty_four, "actions/s", 5000, **per_action),
        entry("task, batch 64, share of the matmul rate", achieved / rate, "-", 0.7,
              achieved_gflop_s=achieved / 1e9, **details),
        entry("task steps/s, batch 1", 3 * small / one, "actions/s", 2000, **per_action),
    ]  # fmt: skip
