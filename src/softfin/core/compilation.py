"""`equinox.filter_jit` for programs that take longer to compile than to run, with the options of XLA that suit them."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import equinox as eqx
import jax

Function = TypeVar("Function", bound=Callable[..., Any])

# The older of XLA's code generators for processors. XLA refuses an option that it does not know.
_OLDER = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__[:2] == (0, 10) else {}


def sooner_compiled(function: Function) -> Function:
    """A third less time to compile; the networks of a surrogate learn as fast."""
    return cast(Function, cast(Any, eqx.filter_jit)(function, compiler_options=_OLDER))


def briefly_used(function: Function) -> Function:
    """Half the time to compile; the virtual tank runs as fast, a surrogate's networks take up to 1.5 times as long."""
    return _compiled(function, 1)


def used_once(function: Function) -> Function:
    """A third of the time to compile, or less; three times as long to run."""
    return _compiled(function, 0)


def _compiled(function: Function, level: int) -> Function:
    if cast(Any, jax.config).read("jax_disable_most_optimizations"):
        level = 0
    options = _OLDER | {"xla_backend_optimization_level": level}
    return cast(Function, cast(Any, eqx.filter_jit)(function, compiler_options=options))
