"""Functions for both kinds of networks: keeping the best weights during training, and the names of
weights in files."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from softfin.core.errors import ArtifactError, LogError, RunError
from softfin.core.quantities import Log
from softfin.storage.run_directory import name_leaves, name_path

UPDATES_A_CALL = 50
"""Largest number of updates per call of a compiled program, after which progress is shown."""


class TrainingState(NamedTuple):
    """Everything needed to resume the training of several networks, or of one with a leading axis
    ``members``."""

    nets: PyTree
    optimiser: PyTree
    best: PyTree
    """Weights with the lowest held-out loss so far, for each network or member."""
    best_loss: PyTree
    """Loss of the best weights: one number for each of several networks, or an array
    ``(members,)``."""


def keep_best_nets(
    state: TrainingState, losses: PyTree, held_out: object, name: str
) -> tuple[TrainingState, bool]:
    """Keep each network's weights if its held-out loss is the lowest so far; return whether any is.
    RunError if one is not finite."""
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((losses, held_out))):
        raise RunError(
            f"fit: the loss of the {name} is not finite; lower learning_rate (--set) and start "
            "again"
        )

    # `better` has an entry for each network or member. It gets the further axes of the weights, so
    # that it is broadcast along their first one.
    def pick(better: Array, new: PyTree, old: PyTree) -> Any:
        return jax.tree.map(
            lambda x, y: jnp.where(jnp.expand_dims(better, range(better.ndim, x.ndim)), x, y),
            new,
            old,
        )

    loss = jax.tree.map(jnp.float32, held_out)
    better = jax.tree.map(lambda new, old: jnp.asarray(new < old), loss, state.best_loss)
    best = jax.tree.map(pick, better, state.nets, state.best)
    state = state._replace(best=best, best_loss=jax.tree.map(jnp.minimum, loss, state.best_loss))
    return state, any(each.any() for each in jax.tree.leaves(better))


def hold_out(logs: Sequence[Log], share: float) -> tuple[Sequence[Log], Sequence[Log]]:
    """Return the logs for training and, the last ones, to hold out; raises LogError if there are
    fewer than two."""
    if (count := len(logs)) < 2:
        raise LogError(
            f"{count} training log: at least 2 are needed, one for training and one held out; "
            "record more, or cut a long file into logs by --rows-per-log"
        )
    held_out = min(count - 1, max(1, round(count * share)))
    return logs[:-held_out], logs[-held_out:]


def check_lengths(logs: Sequence[Log], window: int, part: str) -> None:
    """Raise LogError if a log is too short to predict even one row."""
    for index, log in enumerate(logs):
        if log.rows <= window:
            raise LogError(
                f"{part} log {index}: {log.rows} rows; more than a window of {window} are needed; "
                "record longer"
            )


def window_starts(rows: Sequence[int], window: int, first: int = 0) -> Int[np.ndarray, "windows"]:
    """Return the rows at which windows begin in concatenated logs, from row `first` of each on,
    with the row after each window inside the same log."""
    starts = []
    offset = 0
    for count in rows:
        starts.append(np.arange(offset + first, offset + count - window, dtype=np.int32))
        offset += count
    return np.concatenate(starts)


def name_net_arrays(nets: PyTree) -> dict[str, np.ndarray]:
    """Return the arrays by their paths, such as ``posnet.3.kernel``."""
    return {name: np.asarray(leaf) for name, leaf in name_leaves(nets).items()}


def restored(shapes: PyTree, arrays: Mapping[str, np.ndarray], source: str) -> Any:
    """Return networks of these shapes with the arrays of `named`; ArtifactError if one is missing
    or does not fit."""

    def leaf(path: Any, like: Any) -> Any:
        name = name_path(path)
        array = arrays.get(name)
        if array is None:
            problem = "is missing"
        elif array.shape != like.shape:
            problem = f"has the shape {array.shape}"
        elif np.isfinite(array).all():
            return jnp.asarray(array, like.dtype)
        else:
            problem = "is not finite"
        raise ArtifactError(
            f"{source}: {name} {problem}, must have {like.shape}; copy the whole folder again"
        )

    return jax.tree_util.tree_map_with_path(leaf, shapes)
