"""Fits PosNet and ForceNet to logs: both are trained together on the same windows to predict one
step ahead (Sec. III-B).

Adam on the mean square error of the scaled outputs; early stopping per network on held-out logs,
best weights kept.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt

from softfin.core.compilation import jit
from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.progress import Progress
from softfin.core.quantities import Log
from softfin.core.randomness import named_generator, named_key
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.channels import COLUMNS, COMMAND_COLUMNS, Scaling
from softfin.surrogate.paper.network import FORCENET, POSNET, Network, NetworkConfig, gather
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.training import (
    UPDATES_A_CALL,
    TrainingState,
    check_lengths,
    hold_out,
    keep_best_nets,
    window_starts,
)


class FitConfig(Configuration):
    """How the paper's networks are fitted."""

    posnet: NetworkConfig = POSNET
    """Commands to angle."""
    forcenet: NetworkConfig = FORCENET
    """Motion to force."""
    epochs: PositiveInt = 12
    """Largest number of passes over all windows, during which the learning rate falls to zero
    (cosine)."""
    patience: PositiveInt = 4
    """Number of passes without a lower held-out error of either network after which training
    stops."""
    batch: PositiveInt = 512
    """Windows an update."""
    learning_rate: float = Field(default=1e-3, gt=0)
    """Learning rate of Adam at the start."""
    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Fraction of the training logs held out for early stopping; at least one log."""


class Nets(NamedTuple):
    """Both networks, or a value for each: losses, counts."""

    posnet: PyTree
    forcenet: PyTree


def fit_paper(
    logs: Sequence[Log],
    config: FitConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> Surrogate:
    """Fit both networks to the training logs; continue from the checkpoint in run_directory if
    there is one."""
    training, holding, scaling, starts = split(logs, config)
    table = jnp.asarray(np.concatenate([scaling.table(COLUMNS, log) for log in training]))
    # Calls of equal size, so that one compiled program does them all.
    calls = max(1, -(-(len(starts) // config.batch) // UPDATES_A_CALL))
    updates = len(starts) // config.batch // calls * calls
    learner = PaperLearner(config, updates)
    state = learner.start(named_key(seed, "fit/weights"))
    done = {"epoch": 0, "stale": 0}
    if (resumed := run_directory.load(state)) is not None:
        state, done = resumed
    record = run_directory.log(rewind_to=done["epoch"])
    while done["epoch"] < config.epochs and done["stale"] < config.patience:
        epoch = done["epoch"]
        losses = []
        order = named_generator(seed, f"fit/epoch/{epoch}").permutation(starts)[
            : updates * config.batch
        ]
        key = named_key(seed, f"fit/dropout/{epoch}")
        for call, batches in enumerate(order.reshape(calls, -1, config.batch), 1):
            state, mse = learner.run(state, table, jnp.asarray(batches), key)
            losses.append(mse)
            if progress is not None:
                note = f"epoch {epoch + 1}, rms {mse.posnet**0.5:.4f} / {mse.forcenet**0.5:.4f}"
                progress("fit", (epoch + call / calls) / config.epochs, note)
        held_out = Nets(*(_mean_square_error(net, scaling, holding) for net in state.nets))
        state, improved = keep_best_nets(state, losses, held_out, "networks")
        done = {"epoch": epoch + 1, "stale": 0 if improved else done["stale"] + 1}
        scalars = {}
        for part, values in (("train", np.mean(losses, axis=0)), ("held_out", held_out)):
            for net, value in zip(Nets._fields, values, strict=True):
                scalars[f"{part}/{net}_mse"] = float(value)
        record.write(epoch + 1, **scalars)
        run_directory.save(state, done)
    record.close()
    return Surrogate(state.best.posnet, state.best.forcenet, scaling)


def split(
    logs: Sequence[Log], config: FitConfig
) -> tuple[Sequence[Log], Sequence[Log], Scaling, Int[np.ndarray, "windows"]]:
    """Return training logs, held-out logs, and the scaling and window starts of the former; raises
    LogError."""
    check_lengths(logs, config.posnet.window, "training")
    training, holding = hold_out(logs, config.held_out)
    starts = window_starts([log.rows for log in training], config.posnet.window)
    if len(starts) < config.batch:
        raise LogError(
            f"{len(starts)} training windows are fewer than one batch of {config.batch}; record "
            "more rows"
        )
    return training, holding, Scaling.fit(training), starts


class PaperLearner:
    """The training step of both networks, compiled once."""

    def __init__(self, config: FitConfig, updates: int) -> None:
        self.config = config
        schedule = optax.cosine_decay_schedule(config.learning_rate, config.epochs * updates)
        self.optimiser = optax.adam(schedule)
        self.run = eqx.filter_jit(self._run)

    @jit("none")
    def start(self, key: PRNGKeyArray) -> TrainingState:
        """Fresh weights."""
        posnet_key, forcenet_key = jax.random.split(key)
        nets = Nets(
            Network.create(self.config.posnet, posnet_key),
            Network.create(self.config.forcenet, forcenet_key),
        )
        return TrainingState(
            nets, self.optimiser.init(nets), nets, Nets(*jnp.full(2, jnp.inf, jnp.float32))
        )

    def _run(
        self, state: TrainingState, table: Array, batches: Array, key: PRNGKeyArray
    ) -> tuple[TrainingState, Nets]:
        """Do one update for each of the batches ``(updates, batch)`` of windows in the table; also
        return the mean losses."""

        def update(
            carry: tuple[Nets, PyTree], batch: Int[Array, "batch"]
        ) -> tuple[tuple[Nets, PyTree], Nets]:
            nets, optimiser = carry
            dropout_key = jax.random.fold_in(key, batch[0])
            (_, losses), gradient = eqx.filter_value_and_grad(loss, has_aux=True)(
                nets, table, batch, dropout_key
            )
            step, optimiser = self.optimiser.update(gradient, optimiser)
            return (optax.apply_updates(nets, step), optimiser), losses

        (nets, optimiser), losses = jax.lax.scan(update, (state.nets, state.optimiser), batches)
        return state._replace(nets=nets, optimiser=optimiser), jax.tree.map(jnp.mean, losses)


def loss(
    nets: Nets, table: Float[Array, "rows channels"], starts: Int[Array, "batch"], key: PRNGKeyArray
) -> tuple[Float[Array, ""], Nets]:
    """Return the mean square error of the scaled outputs, summed over both networks, which do not
    depend on each other."""
    window = nets.posnet.config.window
    # The columns of the table are `COLUMNS`: angle, commands, forces.
    num_inputs = 1 + len(COMMAND_COLUMNS)
    inputs = gather(table[:, :num_inputs], starts, window)
    target = table[starts + window]
    # With one key for both, networks with similar layers would drop the same units.
    posnet_key, forcenet_key = jax.random.split(key)
    angle_error = nets.posnet(inputs[:, 1:], posnet_key) - target[:, :1]
    force_error = nets.forcenet(inputs, forcenet_key) - target[:, num_inputs:]
    losses = Nets(jnp.mean(angle_error**2), jnp.mean(force_error**2))
    return losses.posnet + losses.forcenet, losses


@np.errstate(over="ignore", invalid="ignore")
def _mean_square_error(net: Network, scaling: Scaling, logs: Sequence[Log]) -> float:
    tables = [scaling.table((*net.config.channels, *net.config.outputs), log) for log in logs]
    inputs = len(net.config.channels)
    window = net.config.window
    errors = [net.over_table(table[:, :inputs]) - table[window:, inputs:] for table in tables]
    return float(np.mean(np.concatenate(errors) ** 2))
