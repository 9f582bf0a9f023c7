"""Training and storage shared by the surrogate architectures: data split, best weights so far, and
names of weights in files."""

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
"""Maximum number of updates per call of a compiled program; progress is reported between calls."""


class TrainingState(NamedTuple):
    """State of a training run, complete enough to resume it.

    The state contains either several networks or one network whose arrays have a leading axis
    ``members``.
    """

    nets: PyTree
    optimiser: PyTree
    best: PyTree
    """Weights of each network or member with the lowest held-out loss so far."""
    best_loss: PyTree
    """Held-out loss of the best weights: a scalar for each network, or an array ``(members,)``."""


def keep_best_nets(
    state: TrainingState, losses: PyTree, held_out: object, name: str
) -> tuple[TrainingState, bool]:
    """Keep the weights of each network or member if their held-out loss is the lowest so far.

    Returns:
        The new state, and whether any loss improved.

    Raises:
        RunError: If a loss is not finite.
    """
    for leaf in jax.tree.leaves((losses, held_out)):
        if not np.isfinite(leaf).all():
            raise RunError(
                f"fit: the loss of the {name} is NaN or infinite; lower --learning-rate and "
                "start again"
            )

    # `better` is a scalar or has the shape (members,). Axes of length 1 are appended, because NumPy
    # would otherwise broadcast it along the last axis of the weights instead of the first.
    def pick(better: np.ndarray, new: PyTree, old: PyTree) -> PyTree:
        return jax.tree.map(
            lambda x, y: np.where(np.expand_dims(better, tuple(range(better.ndim, x.ndim))), x, y),
            new,
            old,
        )

    loss = jax.tree.map(np.float32, held_out)
    better = jax.tree.map(lambda new, old: np.asarray(new < old), loss, state.best_loss)
    best = jax.tree.map(pick, better, state.nets, state.best)
    state = state._replace(best=best, best_loss=jax.tree.map(np.minimum, loss, state.best_loss))
    return state, any(each.any() for each in jax.tree.leaves(better))


def hold_out(logs: Sequence[Log], share: float) -> tuple[Sequence[Log], Sequence[Log]]:
    """Split logs into training logs and held-out logs: the last logs are held out, or the end of a
    single log."""
    count = len(logs)
    if count == 1:
        rows = round((1 - share) * logs[0].rows)
        return jax.tree.map(lambda x: x[:rows], logs), jax.tree.map(lambda x: x[rows:], logs)
    # Complete logs are held out instead of rows, because neighbouring rows of a log are almost
    # equal and share the same drift.
    held_out = min(count - 1, max(1, round(count * share)))
    return logs[:-held_out], logs[-held_out:]


def check_lengths(logs: Sequence[Log], window: int, part: str) -> None:
    """Raise LogError if a log is too short to predict at least one row."""
    for index, log in enumerate(logs):
        if log.rows <= window:
            raise LogError(
                f"{part} log {index}: {log.rows} rows; expected more than the window of {window} "
                "rows; record longer logs"
            )


def check_history(history: Log, memory: int) -> None:
    """Raise LogError if a history is shorter than the memory of a surrogate."""
    if history.rows < memory:
        raise LogError(
            f"history: {history.rows} rows; this surrogate needs {memory} rows to warm up"
        )


def window_starts(rows: Sequence[int], window: int, first: int = 0) -> Int[np.ndarray, "windows"]:
    """Return the first rows of all windows in concatenated logs.

    Windows start at row `first` of each log or later. The row after a window is the prediction
    target and is in the same log.
    """
    starts = []
    offset = 0
    for count in rows:
        starts.append(np.arange(offset + first, offset + count - window, dtype=np.int32))
        offset += count
    return np.concatenate(starts)


def name_net_arrays(nets: PyTree) -> dict[str, np.ndarray]:
    """Return the arrays of networks by path, e.g. ``posnet.3.kernel``."""
    return {name: np.asarray(leaf) for name, leaf in name_leaves(nets).items()}


def restored(shapes: PyTree, arrays: Mapping[str, np.ndarray], source: str) -> Any:
    """Build networks from their shapes and the arrays of `name_net_arrays`.

    Raises:
        ArtifactError: If an array is missing, has a different shape, or is not finite.
    """

    def leaf(path: tuple[object, ...], like: jax.ShapeDtypeStruct) -> Array:
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
            f"{source}: {name} {problem}; expected a finite array of shape {like.shape}; "
            "copy the complete folder again"
        )

    return jax.tree_util.tree_map_with_path(leaf, shapes)
