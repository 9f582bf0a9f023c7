"""PosNet and ForceNet as a Plant: commands in and readings out at 100 Hz (paper Sec. III-C1).

    command ──> last 100 commands ──> PosNet ──> angle ──> last 100 angles ─┐
                        └───────────────────────────────────────────────────┴──> ForceNet ──> force

While a command is held, all ticks of an action can go through each network at once: PosNet sees
only commands, and ForceNet sees angles that PosNet has already predicted. Only the new ticks are
computed.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.action_clock import MAX_ACTION_TICKS
from softfin.core.errors import ArtifactError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Ticks, rest_command
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits, Log, Reading, tick_at
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, NetPrediction, Scaling
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.training import name_net_arrays, restored


class SurrogateState(NamedTuple):
    """Ticks since the start [10 ms] and the last second, scaled; the newest sample last."""

    tick: Int[Array, ""]
    commands: Float[Array, "2 window"]
    angles: Float[Array, "window"]


class Surrogate(eqx.Module):
    """The paper's surrogate of a fin; meets the Plant contract."""

    model: ClassVar[str] = "paper"
    posnet: Network
    forcenet: Network
    scaling: Scaling = eqx.field(static=True)

    def __check_init__(self) -> None:
        posnet = self.posnet.config.window
        forcenet = self.forcenet.config.window
        if posnet != forcenet:
            raise ArtifactError(
                f"PosNet sees {posnet} samples and ForceNet {forcenet}; both must see the same "
                "window"
            )

    @property
    def window(self) -> int:
        """Number of past samples that both networks see."""
        return self.posnet.config.window

    memory = window
    """Rows of a log that `warm` needs."""

    @property
    def limits(self) -> Limits:
        """The range of the commands in the training data: outside it the networks extrapolate."""
        angle, velocity = (self.scaling.channels[name] for name in COMMAND_COLUMNS)
        return Limits(angle.data_min, angle.data_max, velocity.data_min, velocity.data_max)

    def init(self, key: PRNGKeyArray) -> SurrogateState:
        """Return the state of a fin at rest at angle 0 for longer than the window; the key is
        unused."""
        rest = self._scaled(rest_command(self.limits))
        angle = jnp.full(self.window, self.scaling.scaled(ANGLE, jnp.float32(0)))
        return SurrogateState(jnp.int32(0), jnp.tile(rest[:, None], self.window), angle)

    def warm(self, history: Log) -> SurrogateState:
        """Return the state after a recorded history, of which the last `memory` rows are used;
        raises LogError if it is shorter."""
        if history.rows < self.memory:
            raise LogError(
                f"{history.rows} rows of history; this surrogate needs {self.memory} rows to warm "
                "up"
            )
        table = self.scaling.table((*COMMAND_COLUMNS, ANGLE), history)[-self.window :].T
        # The command of the last row is still to come; the oldest command in the state drops out
        # before it is used.
        commands = np.concatenate([table[:2, :1], table[:2, :-1]], axis=1)
        tick = tick_at(float(history.reading.time[-1]))
        return SurrogateState(jnp.int32(tick), jnp.asarray(commands), jnp.asarray(table[2]))

    def advance(
        self, state: SurrogateState, command: Command, ticks: int
    ) -> tuple[SurrogateState, Reading]:
        """Hold the command for `ticks` samples; all of them go through each network as one
        batch."""
        return self._held(state, command, ticks, ticks)

    def hold_action(
        self, state: SurrogateState, command: Command, ticks: Ticks
    ) -> tuple[SurrogateState, Reading]:
        """Hold the command for an action, as one batch with the length of the longest action."""
        return self._held(state, command, MAX_ACTION_TICKS, ticks)

    def _held(
        self, state: SurrogateState, command: Command, rows: int, ticks: Ticks
    ) -> tuple[SurrogateState, Reading]:
        """Return readings with a fixed number of rows, of which the first `ticks` are valid."""
        # Window k ends with the k-th held command and the angle at which it was issued; from it the
        # networks predict angle and force one sample later.
        held = jnp.tile(self._scaled(command)[:, None], rows)
        commands = jnp.concatenate([state.commands, held], axis=1)
        passed = windows(commands[:, 1:], self.window)
        angles = jnp.concatenate([state.angles, self.posnet(passed)[:, 0]])
        motion = jnp.concatenate([windows(angles[None, :-1], self.window), passed], axis=1)
        force = self.scaling.physical(FORCES, self.forcenet(motion))
        # One more angle, because the velocity is the difference of two.
        angle = self.scaling.physical([ANGLE], angles[-rows - 1 :, None])[:, 0]
        time = (state.tick + 1 + jnp.arange(rows)) * jnp.float32(TICK_S)
        reading = Reading(time, angle[1:], jnp.diff(angle) * RATE_HZ, force)
        # The state keeps the window that ends at the last valid row.
        commands, angles = (
            jax.lax.dynamic_slice_in_dim(x, ticks, self.window, -1) for x in (commands, angles)
        )
        return SurrogateState(state.tick + ticks, commands, angles), reading

    def _scaled(self, command: Command) -> Float[Array, "2"]:
        angle, velocity = COMMAND_COLUMNS
        return jnp.stack(
            [
                self.scaling.scaled(angle, command.angle),
                self.scaling.scaled(velocity, command.velocity),
            ]
        )

    def predict_angle(self, log: Log) -> Float[np.ndarray, "predicted"]:
        """Return PosNet's angles from the commands of a log, for its rows from `window` on
        [rad]."""
        angle = self.posnet.over_table(self.scaling.table(COMMAND_COLUMNS, log))
        return np.asarray(self.scaling.physical([ANGLE], jnp.asarray(angle)))[:, 0]

    def predict_force(self, log: Log, free_running: bool) -> Float[np.ndarray, "predicted 2"]:
        """Return ForceNet's forces for the rows of a log from `window` on [N], from the measured
        angles or from PosNet's."""
        table = self.scaling.table((ANGLE, *COMMAND_COLUMNS), log)
        if free_running:
            # The first window has no prediction.
            table[self.window :, 0] = self.posnet.over_table(table[:, 1:])[:, 0]
        return np.asarray(
            self.scaling.physical(FORCES, jnp.asarray(self.forcenet.over_table(table)))
        )

    def predictions(self, logs: Sequence[Log]) -> dict[str, NetPrediction]:
        """Return predictions of logs by PosNet, and by ForceNet with the measured angle and with
        PosNet's."""
        posnet = self.posnet.config.parameters()
        forcenet = self.forcenet.config.parameters()
        angle = [self.predict_angle(log)[:, None] for log in logs]
        measured = [self.predict_force(log, free_running=False) for log in logs]
        free = [self.predict_force(log, free_running=True) for log in logs]
        return {
            "posnet": NetPrediction((ANGLE,), angle, self.window, posnet),
            "forcenet_measured": NetPrediction(FORCES, measured, self.window, forcenet),
            "forcenet_free_running": NetPrediction(FORCES, free, self.window, forcenet),
        }

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin."""
        return self.posnet.config.flops() + self.forcenet.config.flops()

    def parameters(self) -> int:
        """Number of trainable parameters of both networks."""
        return self.posnet.config.parameters() + self.forcenet.config.parameters()

    def to_files(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Entries of ``surrogate.json``, and the weights by name: ``posnet.3.kernel``."""
        nets = {"posnet": self.posnet, "forcenet": self.forcenet}
        return {
            "networks": {name: net.config.model_dump(mode="json") for name, net in nets.items()},
            "parameters": {name: net.config.parameters() for name, net in nets.items()},
            "scaling": self.scaling.model_dump(mode="json")["channels"],
        }, name_net_arrays({name: net.layers for name, net in nets.items()})

    @classmethod
    def from_files(
        cls, description: JsonObject, weights: dict[str, np.ndarray], source: str
    ) -> "Surrogate":
        """Build the surrogate that `to_files` described; raises ArtifactError if channels or
        weights do not fit."""
        scaling = Scaling(channels=description["scaling"])
        scaling.require(source)
        posnet = NetworkConfig.model_validate(description["networks"]["posnet"])
        forcenet = NetworkConfig.model_validate(description["networks"]["forcenet"])
        shapes = {"posnet": posnet.shapes(), "forcenet": forcenet.shapes()}
        layers = restored(shapes, weights, source)
        return cls(
            Network(posnet, layers["posnet"]), Network(forcenet, layers["forcenet"]), scaling
        )


def windows(
    series: Float[Array, "channels samples"], window: int
) -> Float[Array, "count channels window"]:
    """Return every window of `window` samples, the oldest first: ``count = samples - window +
    1``."""
    count = series.shape[1] - window + 1
    rows = jnp.arange(count)[:, None] + jnp.arange(window)
    return jnp.swapaxes(series[:, rows], 0, 1)
