"""Training time and memory against the number of cells: all are agents of one program, so many cost
little each.

Two updates of each grid with the paper's LSTM-PPO, after compilation and without scoring; a cell's
share of the time of the largest grid is held against the time of a grid of one.
"""

import time
from typing import Any

import jax

from benchmarks.controllers import PAPER_PRESETS
from benchmarks.measure import entry, seconds
from benchmarks.nets import published_layout
from softfin.core.plant import Plant
from softfin.core.randomness import named_key
from softfin.learning.ppo import PPO
from softfin.task.references import PAPER_RANGE, divide, stack_references
from softfin.task.task import ForceTracking

SIDES = (1, 2, 3, 5, 7)
"""Cells along x and along y."""

UPDATES = 2


def measured(plant: Plant, side: int) -> dict[str, Any]:
    """Of a grid of side x side cells."""
    config = PAPER_PRESETS["grid"]
    learner = PPO(ForceTracking(plant, config.task), config.ppo, config.policy, UPDATES)
    cells = divide(PAPER_RANGE, side, side)
    keys = jax.numpy.stack([named_key(0, f"cells/{cell}") for cell in cells])
    begin = time.perf_counter()
    agents = jax.jit(jax.vmap(learner.init))(keys, stack_references(cells))
    update = jax.jit(jax.vmap(learner.update))
    agents, _ = jax.block_until_ready(update(agents))
    compiled = time.perf_counter() - begin

    def updates() -> Any:
        now = agents
        for _ in range(UPDATES):
            now, _ = update(now)
        return now

    taken = seconds(updates) / UPDATES
    return {
        "cells": len(cells),
        "update_s": taken,
        "compile_s": compiled,
        "weights_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(agents.policy)) / len(cells),
    }


def main() -> list[dict[str, Any]]:
    plant = published_layout()
    rows = [measured(plant, side) for side in SIDES]
    one = rows[0]
    most = rows[-1]
    details: dict[str, Any] = {}
    for row in rows:
        details[f"update_s_{row['cells']}_cells"] = row["update_s"]
    details |= {
        "compile_s": most["compile_s"],
        "weights_kb_a_cell": most["weights_bytes"] / 1e3,
        "training_kb_a_cell": 3 * most["weights_bytes"] / 1e3,
    }
    share = most["update_s"] / most["cells"] / one["update_s"]
    return [
        entry(
            f"a cell of {most['cells']} / a cell alone, time of an update",
            share,
            "ratio",
            1.0,
            False,
            **details,
        ),
        entry("weights of a cell", most["weights_bytes"] / 1e3, "kB", 200, False),
    ]
