"""Streaming surrogate against the paper's: FLOPs a tick, and task steps a second at a batch of 256,
no learning.

Random weights: speed does not depend on their values. The streaming ensemble has its default size
and is counted whole.
"""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.flops import flops_per_tick
from benchmarks.measure import entry, interleaved, matmul
from benchmarks.nets import paper_layout
from benchmarks.task import TICKS, steps
from softfin.core.quantities import PAPER_LIMITS
from softfin.surrogate import StreamingConfig, StreamingSurrogate
from softfin.surrogate.paper.network import FORCENET
from softfin.surrogate.streaming.ensemble import Familiarity, Interval, ensemble, remembered, single
from softfin.surrogate.streaming.segments import Motion, Scales
from softfin.task.task import ForceTracking, TaskConfig

BATCH = 256
CYCLES = 8


def streaming_layout() -> StreamingSurrogate:
    """As `softfin fit` makes it."""
    config = StreamingConfig()
    scales = Scales(angle_rad=0.8, velocity_rad_s=2.0, change_rad_s=0.25, force_n=2.2)
    members = ensemble(config.members, config.drive, config.force, scales, jax.random.key(0))
    size = remembered(single(members.force).start(Motion(jnp.zeros(()), jnp.zeros(())))).size
    interval = Interval(coverage=0.9, factor=1.6, floor_n=0.05, windows=1, logs=10)
    return StreamingSurrogate(
        members, PAPER_LIMITS, interval, Familiarity(jnp.zeros(size), jnp.eye(size))
    )


def main() -> list[dict[str, Any]]:
    paper = paper_layout(FORCENET)
    streaming = streaming_layout()
    product, flops = matmul()
    calls = [
        steps(ForceTracking(plant, TaskConfig()), BATCH, CYCLES) for plant in (paper, streaming)
    ]
    old, new, square = interleaved([*calls, product])
    rate = flops / square
    actions = 3 * CYCLES * BATCH
    ticks = CYCLES * BATCH * TICKS
    return [
        entry(
            "surrogate, FLOPs a tick, streaming / paper",
            flops_per_tick(streaming) / flops_per_tick(paper),
            "ratio",
            0.2,
            at_least=False,
            streaming=flops_per_tick(streaming),
            paper=flops_per_tick(paper),
        ),
        entry(
            "surrogate, task steps/s at batch 256, streaming / paper",
            old / new,
            "ratio",
            2,
            streaming_actions_per_s=actions / new,
            paper_actions_per_s=actions / old,
            matmul_gflop_s=rate / 1e9,
            streaming_share_of_matmul=ticks * flops_per_tick(streaming) / new / rate,
            paper_share_of_matmul=ticks * flops_per_tick(paper) / old / rate,
        ),
    ]
