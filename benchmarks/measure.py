"""Timing, and the machine's single-precision matrix-product rate that speeds are held against."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

MATMUL = 2048
"""Rows and columns: 50 MB in all, so that the arithmetic and not the memory is timed."""


def seconds(call: Callable[[], Any]) -> float:
    """Wall-clock time of one call, all its arrays ready."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def interleaved(calls: Sequence[Callable[[], Any]], repeats: int = 9) -> list[float]:
    """Median time of each call, taken in turn so that a drift of the machine's speed meets them
    all."""
    for call in calls:
        seconds(call)
    rounds = [[seconds(call) for call in calls] for _ in range(repeats)]
    return [statistics.median(column) for column in zip(*rounds, strict=True)]


def matmul() -> tuple[Callable[[], Any], int]:
    """A large product and its floating-point operations."""
    square = jax.random.normal(jax.random.key(0), (MATMUL, MATMUL), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    return lambda: product(square), 2 * MATMUL**3


def entry(
    figure: str, value: float, unit: str, bar: float, at_least: bool = True, **details: Any
) -> dict[str, Any]:
    """One figure against its bar."""
    met = value >= bar if at_least else value <= bar
    sign = ">=" if at_least else "<="
    return {
        "figure": figure,
        "value": _three(value),
        "unit": unit,
        "bar": f"{sign} {bar:g}",
        "met": met,
    } | {
        name: _three(detail) if isinstance(detail, float) else detail
        for name, detail in details.items()
    }


def _three(value: float) -> float:
    return float(f"{value:.4g}")
