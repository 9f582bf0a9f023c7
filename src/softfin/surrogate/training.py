"""The loop in which all nets learn: rounds of updates, the loss on held-out logs after each, the best weights kept."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.errors import LogError, RunError
from softfin.core.quantities import Log

UPDATES_A_CALL = 50
"""Updates that a compiled program does at most before progress is shown."""


class TrainingState(NamedTuple):
    """Everything that a resumed run needs of nets that learn side by side."""

    nets: Any
    """Several nets, or one net whose arrays have a leading axis ``members``."""
    optimiser: Any
    best: Any
    """Weights with the least held-out loss so far, of each net or member."""
    best_loss: Any
    """That loss: one number for each of several nets, or an array ``(members,)``."""


Call: TypeAlias = Callable[[TrainingState], tuple[TrainingState, Any]]
"""Some updates: the state after them, and the mean loss of each net or member."""


class Round(NamedTuple):
    """What a round of updates has led to."""

    state: TrainingState
    losses: list[Any]
    """Training losses, one entry a call."""
    held_out: Any
    """Loss of each net or member on the held-out logs."""
    improved: bool
    """Whether any net or member has never had a lesser one."""


def train(
    state: TrainingState, rounds: Iterable[Sequence[Call]], held_out_loss: Callable[[Any], Any], name: str
) -> Iterator[Round]:
    """Do the calls of each round, then score the nets; raises RunError where a loss of the nets is not finite."""
    for calls in rounds:
        losses = []
        for call in calls:
            state, loss = call(state)
            losses.append(loss)
        # The error below says it better than a warning.
        with np.errstate(over="ignore", invalid="ignore"):
            held_out = held_out_loss(state.nets)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((losses, held_out))):
            raise RunError(f"fit: the loss of the {name} is not finite; lower learning_rate (--set), start anew")
        before = state.best_loss
        state = keep_best(state, jax.tree.map(jnp.float32, held_out))
        improved = any(jax.tree.leaves(jax.tree.map(lambda new, old: (new < old).any(), state.best_loss, before)))
        yield Round(state, losses, held_out, improved)


@eqx.filter_jit
def keep_best(state: TrainingState, loss: Any) -> TrainingState:
    """Keep the weights of each net or member whose held-out loss is less than ever before."""

    def pick(new_loss: Any, old_loss: Any, new: Any, old: Any) -> Any:
        def where(x: Any, y: Any) -> Any:
            return jnp.where(better.reshape(better.shape + (1,) * (x.ndim - better.ndim)), x, y)

        better = jnp.asarray(new_loss < old_loss)
        return jax.tree.map(where, new, old)

    best = jax.tree.map(pick, loss, state.best_loss, state.nets, state.best)
    return state._replace(best=best, best_loss=jax.tree.map(jnp.minimum, loss, state.best_loss))


def held_out_count(logs: int, share: float) -> int:
    """How many of the logs, the last ones, are held out; raises LogError where there are fewer than two."""
    if logs < 2:
        raise LogError(f"{logs} training log: at least 2 are needed, one to learn from and one held out; record more")
    return min(logs - 1, max(1, round(logs * share)))


def check_lengths(logs: Sequence[Log], window: int, part: str) -> None:
    """Raise LogError where a log is too short to predict a single row of."""
    for index, log in enumerate(logs):
        rows = len(log.reading.time)
        if rows <= window:
            raise LogError(
                f"{part} log {index}: {rows} rows; more than a window of {window} are needed, so record longer"
            )
