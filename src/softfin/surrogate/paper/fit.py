"""Fitting: logs in, a surrogate out. Both nets learn side by side from the same windows, one step ahead (Sec. III-B).

Adam on the mean square error of the scaled outputs; early stopping per net on held-out logs, best weights kept.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.compilation import used_once
from softfin.core.configuration import Configuration
from softfin.core.errors import LogError, RunError
from softfin.core.quantities import Log
from softfin.core.randomness import generator_of, key_of
from softfin.storage.run_directory import Workspace
from softfin.surrogate.paper.forcenet import FORCENET, FORCES
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.paper.posnet import COMMANDS, POSNET
from softfin.surrogate.paper.predict import channels_of, gather, over_table, scaled_table
from softfin.surrogate.paper.scaling import Scaling
from softfin.surrogate.paper.surrogate import ANGLE, Surrogate

COLUMNS = (ANGLE, *COMMANDS, *FORCES)
"""Of the table that training gathers its windows from: ForceNet's channels first, PosNet's within them."""


class FitConfig(Configuration):
    """How a surrogate is fitted."""

    posnet: NetworkConfig = POSNET
    """Commands to angle."""
    forcenet: NetworkConfig = FORCENET
    """Motion to force."""
    epochs: PositiveInt = 12
    """Most passes over all windows; the learning rate falls to zero over them (cosine)."""
    patience: PositiveInt = 4
    """Passes without a better held-out error of either net before training stops."""
    batch: PositiveInt = 512
    """Windows an update."""
    learning_rate: float = Field(default=1e-3, gt=0)
    """Of Adam, at the start."""
    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Share of the training logs that is kept for early stopping; at least one log."""


class Nets(NamedTuple):
    """Both networks, or something of each: losses, counts."""

    posnet: Any
    forcenet: Any


class FitState(NamedTuple):
    """All that a resumed run needs."""

    nets: Nets
    optimiser: Any
    best: Nets
    best_loss: Nets


Progress = Callable[[str, float, str], None]
"""What is going on, how much of it is done (0 .. 1), the newest figures."""

UPDATES_A_CALL = 50


def fit(
    logs: Sequence[Log], config: FitConfig, seed: int, workspace: Workspace, progress: Progress | None = None
) -> Surrogate:
    """Fit both nets to the training logs; goes on from the workspace's checkpoint where there is one.

    Raises:
        LogError: too few logs, or logs too short for one window.
        RunError: the loss is no longer finite.
    """
    training, holding, scaling, starts = _split(logs, config)
    table = jnp.asarray(np.concatenate([scaled_table(scaling, COLUMNS, log) for log in training]))
    call, calls = _calls(len(starts) // config.batch)
    updates = call * calls

    learner = Learner(config, updates)
    state, done = learner.start(key_of(seed, "fit/weights")), {"epoch": 0, "stale": 0}
    if (resumed := workspace.load(state)) is not None:
        state, done = resumed
    record = workspace.log(rewind_to=done["epoch"])
    for epoch in range(done["epoch"], config.epochs):
        if done["stale"] >= config.patience:
            break
        order = generator_of(seed, f"fit/epoch/{epoch}").permutation(starts)[: updates * config.batch]
        batches = order.reshape(calls, call, config.batch)
        state, losses = _epoch(learner, state, table, batches, key_of(seed, f"fit/dropout/{epoch}"), epoch, progress)
        validation = Nets(*(_held_out_loss(net, scaling, holding) for net in state.nets))
        if not np.isfinite([*losses, *validation]).all():
            raise RunError(f"fit: the loss is not finite in epoch {epoch + 1}; lower learning_rate (--set), start anew")
        better = Nets(*(now < float(best) for now, best in zip(validation, state.best_loss, strict=True)))
        state = _keep_best(state, validation, better)
        done = {"epoch": epoch + 1, "stale": 0 if any(better) else done["stale"] + 1}
        record.write(epoch + 1, **_scalars(losses, validation))
        workspace.save(state, done)
    record.close()
    return Surrogate(*state.best, scaling)


def check_fit(logs: Sequence[Log], config: FitConfig) -> None:
    """Raise LogError where `fit` would before it begins."""
    _split(logs, config)


def _split(
    logs: Sequence[Log], config: FitConfig
) -> tuple[Sequence[Log], Sequence[Log], Scaling, Int[np.ndarray, "windows"]]:
    """Logs to learn from, logs held out, and of the former the scaling and where windows begin."""
    check_lengths(logs, config.posnet.window, "training")
    held = held_out(len(logs), config.held_out)
    training, holding = logs[:-held], logs[-held:]
    columns = [channels_of(log) for log in training]
    scaling = Scaling.fit({name: np.concatenate([each[name] for each in columns]) for name in COLUMNS})
    starts = window_starts([len(log.reading.time) for log in training], config.posnet.window)
    if len(starts) < config.batch:
        raise LogError(f"{len(starts)} training windows are fewer than one batch of {config.batch}; record more rows")
    return training, holding, scaling, starts


class Learner:
    """The update of both nets, compiled once."""

    def __init__(self, config: FitConfig, updates: int) -> None:
        self.config = config
        schedule = optax.cosine_decay_schedule(config.learning_rate, config.epochs * updates)
        self.optimiser = optax.adam(schedule)
        self.run = eqx.filter_jit(self._run)

    def start(self, key: PRNGKeyArray) -> FitState:
        """Fresh weights."""
        state: FitState = used_once(self._start)(key)
        return state

    def _start(self, key: PRNGKeyArray) -> FitState:
        keys = jax.random.split(key)
        nets = Nets(Network.create(self.config.posnet, keys[0]), Network.create(self.config.forcenet, keys[1]))
        worst = Nets(jnp.float32(jnp.inf), jnp.float32(jnp.inf))
        return FitState(nets, self.optimiser.init(nets), nets, worst)

    def _run(
        self,
        learning: tuple[Nets, Any],
        table: Float[Array, "rows channels"],
        batches: Int[Array, "updates batch"],
        key: PRNGKeyArray,
    ) -> tuple[tuple[Nets, Any], Nets]:
        def update(carry: tuple[Nets, Any], batch: Int[Array, "batch"]) -> tuple[tuple[Nets, Any], Nets]:
            nets, optimiser = carry
            fresh = jax.random.fold_in(key, batch[0])
            (_, losses), gradient = eqx.filter_value_and_grad(loss, has_aux=True)(nets, table, batch, fresh)
            step, optimiser = self.optimiser.update(gradient, optimiser)
            return (optax.apply_updates(nets, step), optimiser), losses

        carry, losses = jax.lax.scan(update, learning, batches)
        return carry, jax.tree.map(jnp.mean, losses)


def loss(
    nets: Nets, table: Float[Array, "rows channels"], starts: Int[Array, "batch"], key: PRNGKeyArray
) -> tuple[Float[Array, ""], Nets]:
    """Mean square error of the scaled outputs, summed over both nets: each sees only its own."""
    window = nets.posnet.config.window
    seen = gather(table[:, : 1 + len(COMMANDS)], starts, window)
    target = table[starts + window]
    # With one key for both, nets of like layers would drop the same units.
    posnet_key, forcenet_key = jax.random.split(key)
    losses = Nets(
        jnp.mean((nets.posnet(seen[:, 1:], posnet_key) - target[:, :1]) ** 2),
        jnp.mean((nets.forcenet(seen, forcenet_key) - target[:, 1 + len(COMMANDS) :]) ** 2),
    )
    return losses.posnet + losses.forcenet, losses


def check_lengths(logs: Sequence[Log], window: int, part: str) -> None:
    """Raise LogError where a log is too short to predict a single row of."""
    for index, log in enumerate(logs):
        rows = len(log.reading.time)
        if rows <= window:
            raise LogError(
                f"{part} log {index}: {rows} rows; more than a window of {window} are needed, so record longer"
            )


def window_starts(rows: Sequence[int], window: int) -> Int[np.ndarray, "windows"]:
    """Where windows begin in logs laid end to end, with their target inside the same log."""
    offsets = np.cumsum([0, *rows[:-1]])
    parts = [offset + np.arange(count - window) for offset, count in zip(offsets, rows, strict=True) if count > window]
    return np.concatenate(parts).astype(np.int32) if parts else np.zeros(0, np.int32)


def _epoch(
    learner: Learner,
    state: FitState,
    table: Float[Array, "rows channels"],
    batches: Int[np.ndarray, "calls updates batch"],
    key: PRNGKeyArray,
    epoch: int,
    progress: Progress | None,
) -> tuple[FitState, Nets]:
    learning, each = (state.nets, state.optimiser), []
    for call, some in enumerate(batches):
        learning, losses = learner.run(learning, table, jnp.asarray(some), key)
        each.append(losses)
        if progress is not None:
            done = (epoch + (call + 1) / len(batches)) / learner.config.epochs
            progress("fit", done, f"epoch {epoch + 1}, rms {losses.posnet**0.5:.4f} / {losses.forcenet**0.5:.4f}")
    mean = Nets(*(float(np.mean(column)) for column in zip(*each, strict=True)))
    return state._replace(nets=learning[0], optimiser=learning[1]), mean


def _calls(updates: int) -> tuple[int, int]:
    """Updates a call and calls an epoch: equal calls, so that one compiled program does them all."""
    calls = max(1, -(-updates // UPDATES_A_CALL))
    return updates // calls, calls


def held_out(logs: int, share: float) -> int:
    """How many of the logs, the last ones; raises LogError where there are fewer than two."""
    if logs < 2:
        raise LogError(f"{logs} training log: at least 2 are needed, one to learn from and one held out; record more")
    return min(logs - 1, max(1, round(logs * share)))


def _held_out_loss(net: Network, scaling: Scaling, logs: Sequence[Log]) -> float:
    tables = [scaled_table(scaling, (*net.config.channels, *net.config.outputs), log) for log in logs]
    inputs, window = len(net.config.channels), net.config.window
    errors = [over_table(net, table[:, :inputs]) - table[window:, inputs:] for table in tables]
    return float(np.mean(np.concatenate(errors) ** 2))


def _keep_best(state: FitState, validation: Nets, better: Nets) -> FitState:
    best = Nets(*(new if b else old for new, old, b in zip(*state[::2], better, strict=True)))
    least = Nets(*(jnp.float32(v) if b else old for v, old, b in zip(validation, state.best_loss, better, strict=True)))
    return state._replace(best=best, best_loss=least)


def _scalars(training: Nets, validation: Nets) -> dict[str, float]:
    parts = {"train": training, "held_out": validation}
    return {
        f"{part}/{net}_mse": float(value) for part, losses in parts.items() for net, value in losses._asdict().items()
    }
