"""Virtual tank: simulated seconds a second, against real time and the machine's matrix-product
rate."""

import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.measure import entry, interleaved, matmul
from softfin.core.plant import roll
from softfin.core.quantities import TICK_S, Command
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate
from softfin.tank import Tank, TankConfig

TICKS = 1000
MORE = (8, 32, 512)
"""Batches beside those of 1 and 128 fins."""


def moving(tank: Tank, batch: int) -> Callable[[], Any]:
    """A call that moves `batch` fins for `TICKS` ticks, each with a command of its own at every
    tick."""
    low = tank.limits.velocity_min
    high = tank.limits.velocity_max
    angle = jax.random.uniform(jax.random.key(1), (batch, TICKS // 50), minval=-1.5, maxval=1.5)
    velocity = jax.random.uniform(jax.random.key(2), (batch, TICKS // 50), minval=low, maxval=high)
    commands = Command(*(jnp.repeat(channel, 50, axis=1) for channel in (angle, velocity)))
    keys = jax.random.split(jax.random.key(0), batch)

    def one(key: jax.Array, command: Command) -> Any:
        return roll(tank, tank.init(key), command)[1]

    program = jax.jit(jax.vmap(one))
    return lambda: program(keys, commands)


def flops() -> int:
    """Of a tick of one fin: XLA's count of the program as written, before it is compiled."""
    tank = Tank(TankConfig(steps_per_tick=1))
    state = tank.init(jax.random.key(0))
    command = Command(jnp.float32(1.0), jnp.float32(5.0))

    def step(state: Any, command: Command) -> Any:
        planned = tank.drive.plan(state.drive, command, TICK_S)
        shaft = tank.drive.shaft(state.drive, planned, TICK_S)
        fin, rate, _ = tank.fin.step(state.fin, shaft, tank.water.around(state.flow), TICK_S)
        return fin, tank.drive.follow(state.drive, planned, rate, TICK_S)

    def counted(call: Callable[[Any, Command], Any]) -> float:
        return float(jax.jit(call).lower(state, command).cost_analysis()["flops"])

    whole = counted(lambda state, command: tank.advance(state, command, 1))
    return round(whole + (TankConfig().steps_per_tick - 1) * counted(step))


def main() -> list[dict[str, Any]]:
    tank = Tank()
    cores = len(os.sched_getaffinity(0))
    product, of_product = matmul()
    calls = [moving(tank, batch) for batch in (128, 1, *MORE)]
    many, one, *more, square = interleaved([*calls, product], repeats=5)
    rate = of_product / square
    per_tick = flops()
    achieved = per_tick * 128 * TICKS / many
    of_batches = {
        f"batch_{batch}": batch * TICKS * TICK_S / each / cores
        for batch, each in zip(MORE, more, strict=True)
    }
    return [
        entry(
            "tank, 128 fins, simulated over real time, a core",
            128 * TICKS * TICK_S / many / cores,
            "-",
            150,
            cores=cores,
            ticks_per_s=128 * TICKS / many,
            flops_per_tick=per_tick,
            achieved_gflop_s=achieved / 1e9,
            matmul_gflop_s=rate / 1e9,
            share_of_matmul=achieved / rate,
            **of_batches,
        ),
        entry("tank, one fin, simulated over real time", TICKS * TICK_S / one, "-", 20),
        entry(
            "tank, compile time of the collect program", compile_time(tank), "s", 20, at_least=False
        ),
    ]


def compile_time(tank: Tank) -> float:
    """Of a first call of what `softfin collect` runs, on two rows of 100 logs, nothing cached."""
    jax.config.update("jax_enable_compilation_cache", False)
    jax.clear_caches()
    start = time.perf_counter()
    keys = list(jax.random.split(jax.random.key(0), 100))
    list(simulate([tank] * 100, keys, 2, ExcitationConfig(), 100, lambda rows: None))
    return time.perf_counter() - start
