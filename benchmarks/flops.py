"""Floating-point operations of the matrix products in a program, two for each multiplication and
addition."""

from collections.abc import Callable
from math import prod
from typing import Any

import jax

from softfin.core.plant import Plant, rest_command


def flops_per_tick(plant: Plant) -> int:
    """Those of one sample of one fin, over all members of an ensemble."""
    start = plant.init(jax.random.key(0))
    return count_flops(lambda: plant.advance(start, rest_command(plant.limits), 1))


def count_flops(function: Callable[..., Any], *arguments: Any) -> int:
    """Those of one call; arguments may be shapes."""
    return _of_program(jax.make_jaxpr(function)(*arguments).jaxpr)


def _of_program(program: Any) -> int:
    flops = 0
    for step in program.eqns:
        if step.primitive.name == "dot_general":
            # Each element of the result is a sum over the contracted axes.
            (contracted, _), _ = step.params["dimension_numbers"]
            shape = step.invars[0].aval.shape
            flops += 2 * step.outvars[0].aval.size * prod(shape[axis] for axis in contracted)
        inner = [
            getattr(value, "jaxpr", value)
            for value in jax.tree.leaves(
                list(step.params.values()), is_leaf=lambda value: hasattr(value, "jaxpr")
            )
            if hasattr(getattr(value, "jaxpr", value), "eqns")
        ]
        flops += step.params.get("length", 1) * sum(map(_of_program, inner))
    return flops
