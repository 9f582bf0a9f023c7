"""A plain gated recurrent unit (GRU) as an architecture of surrogates: commands in, angle and force
out.

    command ──> GRU ──> linear layer ──> angle, force

softfin finds it by its name, in the folder of this file or after it is installed:

    softfin fit recordings --model softfin_gru:ARCHITECTURE --out surrogate

It is an example of an architecture of your own, and a baseline: it contains no knowledge about
drives, fins or water.
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

from softfin.core.errors import LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import rest_command
from softfin.core.progress import Progress, silent
from softfin.core.quantities import (
    RATE_HZ,
    TICK_S,
    Command,
    Limits,
    Log,
    Reading,
    command_limits,
    tick_at,
)
from softfin.core.randomness import named_key
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import Architecture, SurrogateConfig
from softfin.surrogate.channels import (
    ANGLE,
    COMMAND_COLUMNS,
    FORCES,
    SKIPPED,
    NetPrediction,
    Scaling,
)
from softfin.surrogate.training import (
    TrainingState,
    hold_out,
    keep_best_nets,
    name_net_arrays,
    restored,
    window_starts,
)

OUTPUTS = (ANGLE, *FORCES)


NAME = "softfin_gru:ARCHITECTURE"
"""Name of the architecture for softfin."""


class GruConfig(SurrogateConfig):
    """Configuration of the fit of a GRU."""

    model: ClassVar[str] = NAME

    units: PositiveInt = 64
    """Size of the memory."""
    updates: PositiveInt = 3000
    """Number of updates, over which the learning rate decays to zero (cosine)."""
    updates_per_scoring: PositiveInt = 250
    """Number of updates between two scorings on the held-out logs, after which a checkpoint is
    written."""
    batch: PositiveInt = 32
    """Number of log segments per update."""
    ticks: int = Field(default=300, ge=2)
    """Length of a segment [10 ms]."""
    burn_in: int = Field(default=100, ge=0)
    """Number of ticks at the start of a segment without a loss, because the motion before it is
    unknown."""
    learning_rate: float = Field(default=3e-3, gt=0)
    """Initial learning rate of Adam."""


class GruNet(eqx.Module):
    """The network, for scaled inputs and outputs."""

    cell: eqx.nn.GRUCell
    output: eqx.nn.Linear

    def __init__(self, units: int, key: PRNGKeyArray) -> None:
        cell_key, output_key = jax.random.split(key)
        self.cell = eqx.nn.GRUCell(len(COMMAND_COLUMNS), units, key=cell_key)
        self.output = eqx.nn.Linear(units, len(OUTPUTS), key=output_key)

    def blank(self) -> Float[Array, "units"]:
        """Return an empty memory."""
        return jnp.zeros(self.cell.hidden_size)

    def run(
        self, memory: Float[Array, "units"], commands: Float[Array, "ticks 2"]
    ) -> tuple[Float[Array, "units"], Float[Array, "ticks 3"]]:
        """Apply one command per tick; return the last memory, and the outputs after each tick."""

        def step(memory: Array, command: Array) -> tuple[Array, Array]:
            memory = self.cell(command, memory)
            return memory, self.output(memory)

        return jax.lax.scan(step, memory, commands)


class GruState(NamedTuple):
    """State of the surrogate."""

    tick: Int[Array, ""]
    """Time since the start [10 ms]."""
    memory: Float[Array, "units"]
    angle: Float[Array, ""]
    """Angle of the last reading [rad]."""


class GruSurrogate(eqx.Module):
    """A GRU as a plant; implements `softfin.surrogate.SurrogatePlant`."""

    model: ClassVar[str] = NAME
    memory: ClassVar[int] = 300
    net: GruNet
    scaling: Scaling = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)

    def init(self, key: PRNGKeyArray) -> GruState:
        """Return the state after a rest of `memory` ticks. The key is not used."""
        rest = jnp.tile(self._scaled(rest_command(self.limits)), (self.memory, 1))
        return self._after(rest, 0)

    def warm(self, history: Log) -> GruState:
        """Return the state after the commands of the last `memory` rows of a history."""
        if history.rows < self.memory:
            raise LogError(
                f"history: {history.rows} rows; this surrogate needs {self.memory} rows to warm up"
            )
        # The command of the last row acts after its reading.
        commands = self.scaling.table(COMMAND_COLUMNS, history)[-self.memory : -1]
        return self._after(jnp.asarray(commands), tick_at(float(history.reading.time[-1])))

    def _after(self, commands: Float[Array, "ticks 2"], tick: int) -> GruState:
        memory, outputs = self.net.run(self.net.blank(), commands)
        angle = self.scaling.physical([ANGLE], outputs[-1:, :1])
        return GruState(jnp.int32(tick), memory, angle[0, 0])

    def advance(self, state: GruState, command: Command, ticks: int) -> tuple[GruState, Reading]:
        """Hold the command for `ticks` samples."""
        commands = jnp.tile(self._scaled(command), (ticks, 1))
        memory, outputs = self.net.run(state.memory, commands)
        values = self.scaling.physical(OUTPUTS, outputs)
        angle = values[:, 0]
        velocity = jnp.diff(angle, prepend=state.angle) * RATE_HZ
        time = (state.tick + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        after = GruState(state.tick + ticks, memory, angle[-1])
        return after, Reading(time, angle, velocity, values[:, 1:])

    def _scaled(self, command: Command) -> Float[Array, "2"]:
        angle, velocity = COMMAND_COLUMNS
        return jnp.stack(
            [
                self.scaling.scaled(angle, jnp.float32(command.angle)),
                self.scaling.scaled(velocity, jnp.float32(command.velocity)),
            ]
        )

    def predictions(self, logs: Sequence[Log]) -> dict[str, NetPrediction]:
        """Predict logs from their commands alone."""
        angles = []
        forces = []
        for log in logs:
            outputs = run_log(self.net, jnp.asarray(self.scaling.table(COMMAND_COLUMNS, log)))
            # Row k of the outputs is row k + 1 of the log.
            values = np.asarray(self.scaling.physical(OUTPUTS, outputs[SKIPPED - 1 : -1]))
            angles.append(values[:, :1])
            forces.append(values[:, 1:])
        count = self.parameters()
        return {
            "gru_angle": NetPrediction("GRU, commands to angle", (ANGLE,), angles, None, count),
            "gru_force": NetPrediction("GRU, commands to force", FORCES, forces, None, count),
        }

    def parameters(self) -> int:
        """Return the number of trainable parameters."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.net))

    def to_files(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the entries of ``surrogate.json``, and the weights."""
        description = {
            "units": self.net.cell.hidden_size,
            "scaling": self.scaling.model_dump(mode="json")["channels"],
            "parameters": self.parameters(),
        }
        return description, name_net_arrays(self.net)


def load_gru(description: JsonObject, weights: dict[str, np.ndarray], source: str) -> GruSurrogate:
    """Build the surrogate from the result of `to_files`."""
    scaling = Scaling(channels=description["scaling"])
    scaling.require(source)
    shapes = eqx.filter_eval_shape(GruNet, int(description["units"]), jax.random.key(0))
    limits = Limits.of(description["limits"])
    return GruSurrogate(restored(shapes, weights, source), scaling, limits)


def fit_gru(
    logs: Sequence[Log],
    config: GruConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress = silent,
) -> GruSurrogate:
    """Fit a GRU to the training logs; resume from the checkpoint in `run_directory`, if any."""
    training, holding = hold_out(logs, config.held_out)
    starts = window_starts([log.rows for log in training], config.ticks)
    if config.burn_in >= config.ticks or not starts.size:
        raise LogError(
            f"training logs: no segment of {config.ticks} ticks with a burn_in of {config.burn_in}; "
            "record longer logs, or set ticks and burn_in"
        )
    scaling = Scaling.fit(training)
    table = Table(*scaled_tables(scaling, training), jnp.asarray(starts))
    learner = GruLearner(config, named_key(seed, "fit/segments"))
    state = learner.start(named_key(seed, "fit/weights"))
    done = {"updates": 0}
    if (resumed := run_directory.load(state)) is not None:
        state, done = resumed
    record = run_directory.log(rewind_to=done["updates"])
    while done["updates"] < config.updates:
        first = done["updates"]
        count = min(config.updates_per_scoring, config.updates - first)
        state, loss = learner.run(state, table, jnp.int32(first), count)
        errors = [held_out_error(state.nets, *scaled_tables(scaling, [log])) for log in holding]
        held_out = np.mean(errors)
        state, _ = keep_best_nets(state, loss, held_out, "GRU")
        done["updates"] = first + count
        scalars = {"train/mse": float(loss), "held_out/mse": float(held_out)}
        record.write(done["updates"], **scalars)
        progress("fit", done["updates"] / config.updates, f"rms {float(held_out) ** 0.5:.4f}")
        run_directory.save(state, done)
    return GruSurrogate(state.best, scaling, command_limits(training))


def scaled_tables(
    scaling: Scaling, logs: Sequence[Log]
) -> tuple[Float[Array, "rows 2"], Float[Array, "rows 3"]]:
    """Return the scaled commands and readings of concatenated logs."""
    inputs = [scaling.table(COMMAND_COLUMNS, log) for log in logs]
    targets = [scaling.table(OUTPUTS, log) for log in logs]
    return jnp.asarray(np.concatenate(inputs)), jnp.asarray(np.concatenate(targets))


@eqx.filter_jit
def run_log(net: GruNet, inputs: Float[Array, "rows 2"]) -> Float[Array, "rows 3"]:
    """Return the outputs after each command of a log, from an empty memory."""
    return net.run(net.blank(), inputs)[1]


def held_out_error(
    net: GruNet, inputs: Float[Array, "rows 2"], targets: Float[Array, "rows 3"]
) -> Float[Array, ""]:
    """Return the mean squared error on a log, without its first rows."""
    error = run_log(net, inputs)[:-1] - targets[1:]
    return jnp.mean(error[SKIPPED:] ** 2)


class Table(NamedTuple):
    """Concatenated training logs, scaled."""

    inputs: Float[Array, "rows 2"]
    """Commands."""
    targets: Float[Array, "rows 3"]
    """Angle and force."""
    starts: Int[Array, "choices"]
    """Rows at which a segment can start and lie entirely within one log."""


class GruLearner:
    """Training step on random segments of the training logs."""

    def __init__(self, config: GruConfig, key: PRNGKeyArray) -> None:
        self.config = config
        self.key = key
        schedule = optax.cosine_decay_schedule(config.learning_rate, config.updates)
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self.run = jax.jit(self._run, static_argnums=3)

    def start(self, key: PRNGKeyArray) -> TrainingState:
        """Return the state before the first update."""
        net = GruNet(self.config.units, key)
        return TrainingState(net, self.optimiser.init(net), net, jnp.float32(jnp.inf))

    def loss(self, net: GruNet, table: Table, starts: Int[Array, "batch"]) -> Float[Array, ""]:
        """Return the mean squared error over the segments, after their burn-in."""
        rows = starts[:, None] + jnp.arange(self.config.ticks)
        outputs = jax.vmap(lambda inputs: net.run(net.blank(), inputs)[1])(table.inputs[rows])
        # The reading of a row follows the command of the row before.
        error = outputs - table.targets[rows + 1]
        return jnp.mean(error[:, self.config.burn_in :] ** 2)

    def _run(
        self, state: TrainingState, table: Table, first: Int[Array, ""], count: int
    ) -> tuple[TrainingState, Float[Array, ""]]:
        """Run updates `first` to `first + count - 1`; return the new state and the mean loss."""

        def update(carry: tuple[GruNet, PyTree], number: Int[Array, ""]) -> PyTree:
            net, optimiser = carry
            # The segments depend only on the number of the update, so a resumed fit equals an
            # uninterrupted one.
            key = jax.random.fold_in(self.key, number)
            starts = jax.random.choice(key, table.starts, (self.config.batch,))
            loss, gradient = jax.value_and_grad(self.loss)(net, table, starts)
            step, optimiser = self.optimiser.update(gradient, optimiser)
            return (optax.apply_updates(net, step), optimiser), loss

        carry = (state.nets, state.optimiser)
        (net, optimiser), losses = jax.lax.scan(update, carry, first + jnp.arange(count))
        return state._replace(nets=net, optimiser=optimiser), losses.mean()


ARCHITECTURE = Architecture(config=GruConfig, fit=fit_gru, load=load_gru)
