"""Fits PosNet and ForceNet to logs. Both are trained together on the same windows to predict one
step ahead (Sec. III-B).

Adam minimizes the mean squared error of the scaled outputs. For each network, the weights with the
lowest error on held-out logs are kept, and training stops early if neither network improves.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt

from softfin.core.compilation import jit
from softfin.core.errors import LogError
from softfin.core.progress import Progress
from softfin.core.quantities import Log
from softfin.core.randomness import named_generator, named_key
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.channels import COLUMNS, COMMAND_COLUMNS, Scaling
from softfin.surrogate.paper.network import FORCENET, POSNET, Network, NetworkConfig, gather
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.protocol import SurrogateConfig
from softfin.surrogate.training import (
    UPDATES_A_CALL,
    TrainingState,
    check_lengths,
    hold_out,
    keep_best_nets,
    window_starts,
)

PATIENCE = 4
"""Number of epochs after which training stops if the held-out error of neither network improves."""


class FitConfig(SurrogateConfig):
    """Configuration of the fit of the paper's networks."""

    model: ClassVar[str] = Surrogate.model

    posnet: NetworkConfig = POSNET
    """Network from commands to angle."""
    forcenet: NetworkConfig = FORCENET
    """Network from angle and commands to force."""
    epochs: PositiveInt = 12
    """Maximum number of passes over all windows; the learning rate decays to zero over these passes
    (cosine)."""
    batch: PositiveInt = 512
    """Number of windows per update."""
    learning_rate: float = Field(default=1e-3, gt=0)
    """Initial learning rate of Adam."""


class Nets(NamedTuple):
    """Both networks, or one value per network, such as the loss."""

    posnet: PyTree
    forcenet: PyTree


def fit_paper(
    logs: Sequence[Log],
    config: FitConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> Surrogate:
    """Fit both networks to the training logs; resume from the checkpoint in `run_directory` if
    there is one."""
    training, holding, scaling, starts = split(logs, config)
    table = jnp.asarray(np.concatenate([scaling.table(COLUMNS, log) for log in training]))
    # All calls have the same number of updates, so that they share one compiled program. The
    # windows that are left over differ between epochs, because each epoch has a different order.
    calls = max(1, -(-(len(starts) // config.batch) // UPDATES_A_CALL))
    updates = len(starts) // config.batch // calls * calls
    learner = PaperLearner(config, updates)
    state = learner.start(named_key(seed, "fit/weights"))
    done = {"epoch": 0, "stale": 0}
    if (resumed := run_directory.load(state)) is not None:
        state, done = resumed
    record = run_directory.log(rewind_to=done["epoch"])

    while done["epoch"] < config.epochs and done["stale"] < PATIENCE:
        epoch = done["epoch"]
        # Order and dropout depend only on the seed and the epoch, so resumed and uninterrupted runs
        # are equal.
        shuffled = named_generator(seed, f"fit/epoch/{epoch}").permutation(starts)
        batches = shuffled[: updates * config.batch].reshape(calls, -1, config.batch)
        key = named_key(seed, f"fit/dropout/{epoch}")
        losses = []
        for call, call_batches in enumerate(batches, 1):
            state, mse = learner.run(state, table, jnp.asarray(call_batches), key)
            losses.append(mse)
            if progress is not None:
                note = f"epoch {epoch + 1}, rms {mse.posnet**0.5:.4f} / {mse.forcenet**0.5:.4f}"
                progress("fit", (epoch + call / calls) / config.epochs, note)
        held_out = Nets(
            _mean_square_error(state.nets.posnet, scaling, holding),
            _mean_square_error(state.nets.forcenet, scaling, holding),
        )
        state, improved = keep_best_nets(state, losses, held_out, "networks")
        done = {"epoch": epoch + 1, "stale": 0 if improved else done["stale"] + 1}
        scalars = {}
        for part, values in (("train", np.mean(losses, axis=0)), ("held_out", held_out)):
            for net, value in zip(Nets._fields, values, strict=True):
                scalars[f"{part}/{net}_mse"] = float(value)
        record.write(epoch + 1, **scalars)
        # Save after writing the log, so that an interrupted epoch is repeated and its log entry is
        # removed.
        run_directory.save(state, done)
    return Surrogate(state.best.posnet, state.best.forcenet, scaling)


def split(
    logs: Sequence[Log], config: FitConfig
) -> tuple[Sequence[Log], Sequence[Log], Scaling, Int[np.ndarray, "windows"]]:
    """Return the training and held-out logs, the scaling, and the first rows of the training
    windows.

    Raises:
        LogError: If there are too few logs or rows, or a channel never changes.
    """
    check_lengths(logs, config.posnet.window, "training")
    training, holding = hold_out(logs, config.held_out)
    starts = window_starts([log.rows for log in training], config.posnet.window)
    if len(starts) < config.batch:
        raise LogError(
            f"training logs: {len(starts)} windows are fewer than one batch of {config.batch}; "
            "record more rows"
        )
    return training, holding, Scaling.fit(training), starts


class PaperLearner:
    """Training step of both networks, compiled once."""

    def __init__(self, config: FitConfig, updates: int) -> None:
        self.config = config
        schedule = optax.cosine_decay_schedule(config.learning_rate, config.epochs * updates)
        self.optimiser = optax.adam(schedule)
        self.run = eqx.filter_jit(self._run)

    @jit("none")
    def start(self, key: PRNGKeyArray) -> TrainingState:
        """Return the state before the first update, with new weights."""
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
        """Run one update per batch and return the losses averaged over the batches.

        Args:
            state: State before the updates.
            table: Scaled rows of all training logs, ``(rows, channels)``.
            batches: First rows of the windows, ``(updates, batch)``.
            key: Key of the epoch, for dropout.
        """

        def update(
            carry: tuple[Nets, PyTree], batch: Int[Array, "batch"]
        ) -> tuple[tuple[Nets, PyTree], Nets]:
            nets, optimiser = carry
            # Each window is the first of at most one batch per epoch, so batch[0] identifies the
            # update.
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
    """Return the mean squared error of the scaled outputs, summed over both networks.

    The networks share no weights, so the gradient of each depends only on its own error.
    """
    window = nets.posnet.config.window
    # The columns of the table are `COLUMNS`: angle, commands, forces.
    num_inputs = 1 + len(COMMAND_COLUMNS)
    inputs = gather(table[:, :num_inputs], starts, window)
    # The target is the row after the window.
    target = table[starts + window]
    # With the same key for both networks, similar layers would drop the same units.
    posnet_key, forcenet_key = jax.random.split(key)
    angle_error = nets.posnet(inputs[:, 1:], posnet_key) - target[:, :1]
    force_error = nets.forcenet(inputs, forcenet_key) - target[:, num_inputs:]
    losses = Nets(jnp.mean(angle_error**2), jnp.mean(force_error**2))
    return losses.posnet + losses.forcenet, losses


# A diverged network overflows here; keep_best_nets then raises an error.
@np.errstate(over="ignore", invalid="ignore")
def _mean_square_error(net: Network, scaling: Scaling, logs: Sequence[Log]) -> float:
    """Return the mean squared error of the scaled outputs in the rows after the first window."""
    channels = (*net.config.channels, *net.config.outputs)
    num_inputs = len(net.config.channels)
    errors = []
    for log in logs:
        table = scaling.table(channels, log)
        target = table[net.config.window :, num_inputs:]
        errors.append(net.over_table(table[:, :num_inputs]) - target)
    return float(np.mean(np.concatenate(errors) ** 2))
