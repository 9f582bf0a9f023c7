"""Fitting, of the paper's networks and of streaming ones: samples a second, share of the
matrix-product rate.

A streaming network goes through its stretches tick by tick, with products of a few dozen rows and
columns: that, and the functions between them, keep it far from the rate of large products. What
counts there is the time of a whole fit.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.flops import count_flops
from benchmarks.measure import entry, interleaved, matmul
from softfin.core.quantities import Command
from softfin.surrogate import FitConfig, StreamingConfig
from softfin.surrogate.channels import COLUMNS
from softfin.surrogate.paper.fit import PaperLearner
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.streaming.ensemble import ensemble, forces, single
from softfin.surrogate.streaming.fit import StreamingLearner, force_loss
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, Scales, Table

ROWS = 400_000
UPDATES = 25


def training_flops(config: NetworkConfig) -> int:
    """Forward, gradient of the weights and of the inputs, one matrix product each; none of the
    first layer's inputs."""
    net = Network.create(config, jax.random.key(0))
    window = jnp.zeros((1, len(config.channels), config.window))
    whole = count_flops(net, window)
    first = count_flops(lambda: config.layers[0].apply(net.layers[0], window))
    if config.layers[0].kind == "lstm":
        # Of an LSTM only the products with the data have no gradient to pass on; those with its own
        # past do.
        steps = len(config.channels)
        first = 2 * config.layers[0].units * config.window * (3 + 4 * (steps - 1))
    return 3 * whole - first


def main() -> list[dict[str, Any]]:
    config = FitConfig()
    learner = PaperLearner(config, UPDATES)
    random = np.random.default_rng(0)
    table = jnp.asarray(random.uniform(size=(ROWS, len(COLUMNS))), jnp.float32)
    batches = jnp.asarray(random.integers(0, ROWS - 101, (UPDATES, config.batch)), jnp.int32)
    state = learner.start(jax.random.key(0))
    product, flops = matmul()
    call, square = interleaved(
        [lambda: learner.run(state, table, batches, jax.random.key(1)), product]
    )
    streaming, ticks, per_tick = streaming_updates(random)
    stepped, square_then = interleaved([streaming, product], repeats=3)
    rate = flops / square
    samples = UPDATES * config.batch / call
    each = training_flops(config.posnet) + training_flops(config.forcenet)
    return [
        entry(
            "fit, share of the matmul rate",
            samples * each / rate,
            "-",
            0.5,
            samples_per_s=samples,
            flops_per_sample=each,
            batch=config.batch,
            matmul_gflop_s=rate / 1e9,
        ),
        entry(
            "streaming fit, force nets, minutes for all updates",
            StreamingConfig().force_updates * stepped / 60,
            "min",
            20,
            at_least=False,
            member_ticks_per_s=ticks / stepped,
            flops_per_member_tick=per_tick,
            share_of_matmul=ticks * per_tick / stepped / (flops / square_then),
        ),
    ]


def streaming_updates(random: np.random.Generator) -> tuple[Callable[[], Any], int, int]:
    """A call of one update of the force networks; member-ticks of it, and FLOPs of each: forward,
    weights, inputs."""
    config = StreamingConfig()
    scales = Scales(angle_rad=0.8, velocity_rad_s=2.0, change_rad_s=0.25, force_n=2.2)
    members = ensemble(config.members, config.drive, config.force, scales, jax.random.key(0))
    columns = [jnp.asarray(random.normal(size=ROWS), jnp.float32) for _ in range(4)]
    force = jnp.asarray(random.normal(size=(ROWS, 2)), jnp.float32)
    starts = jnp.arange(MAX_DELAY, ROWS - config.ticks, dtype=jnp.int32)
    table = Table(Command(*columns[:2]), Motion(*columns[2:]), force, starts)
    foretold = Motion(*(jnp.tile(column, (config.members, 1)) for column in columns[2:]))
    learner = StreamingLearner(force_loss, config, config.force_updates)
    state = learner.start(members.force)
    ticks = config.members * config.batch * config.ticks
    motion = Motion(*(column[: config.ticks] for column in columns[2:]))
    per_tick = 3 * count_flops(forces, single(members).force, motion) / config.ticks
    return (
        lambda: list(learner.run(state, table, foretold, [(0, 1)], jax.random.key(1))),
        ticks,
        per_tick,
    )
