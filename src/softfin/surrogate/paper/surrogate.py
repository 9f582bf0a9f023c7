"""PosNet and ForceNet as a Plant, from commands to readings at 100 Hz (paper Sec. III-C1).

    command ──> last 100 commands ──> PosNet ──> angle ──> last 100 angles ─┐
                        └───────────────────────────────────────────────────┴──> ForceNet ──> force

All ticks of an action are computed as one batch per network. This is possible because the command
is held: the input of PosNet contains only commands, and the input of ForceNet adds only angles that
PosNet has already predicted.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.errors import ArtifactError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Ticks, check_commands, check_key, rest_command
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits, Log, Reading, tick_at
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, NetPrediction, Scaling
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.training import check_history, name_net_arrays, restored


class SurrogateState(NamedTuple):
    """Ticks since the start, and the last window of scaled samples, newest last."""

    tick: Int[Array, ""]
    """Time since the start [10 ms]."""
    commands: Float[Array, "2 window"]
    """Scaled target angles and profile velocities [-]."""
    angles: Float[Array, "window"]
    """Scaled angles [-]."""


class Surrogate(eqx.Module):
    """The paper's surrogate of a fin; implements `Plant`."""

    model: ClassVar[str] = "paper"
    posnet: Network
    forcenet: Network
    scaling: Scaling = eqx.field(static=True)

    def __check_init__(self) -> None:
        posnet = self.posnet.config.window
        forcenet = self.forcenet.config.window
        if posnet != forcenet:
            raise ArtifactError(
                f"surrogate: PosNet has a window of {posnet} samples and ForceNet has a window of "
                f"{forcenet}; the windows must be equal"
            )

    @property
    def window(self) -> int:
        """Number of past samples in the input of both networks."""
        return self.posnet.config.window

    memory = window
    """Number of rows of a log that `warm` needs."""

    @property
    def limits(self) -> Limits:
        """Range of the commands in the training data; the networks extrapolate outside it."""
        angle_column, velocity_column = COMMAND_COLUMNS
        angle = self.scaling.channels[angle_column]
        velocity = self.scaling.channels[velocity_column]
        return Limits(angle.data_min, angle.data_max, velocity.data_min, velocity.data_max)

    def init(self, key: PRNGKeyArray) -> SurrogateState:
        """Return the state of a fin that has been at rest for a full window. The key is not
        used."""
        check_key(key)
        command = rest_command(self.limits)
        rest = self._scaled(command)
        angle = jnp.full(self.window, self.scaling.scaled(ANGLE, command.angle))
        return SurrogateState(jnp.int32(0), jnp.tile(rest[:, None], self.window), angle)

    def warm(self, history: Log) -> SurrogateState:
        """Return the state after the last `memory` rows of a recorded history.

        Raises:
            LogError: If the history is too short.
        """
        check_history(history, self.memory)
        table = self.scaling.table((*COMMAND_COLUMNS, ANGLE), history)[-self.window :].T
        # The state ends with the command before the last row, because the next call of `advance`
        # appends the command of the last row. This call also drops the oldest entry before any
        # network uses it, so the entry can be a copy of the first command.
        commands = np.concatenate([table[:2, :1], table[:2, :-1]], axis=1)
        tick = tick_at(float(history.reading.time[-1]))
        return SurrogateState(jnp.int32(tick), jnp.asarray(commands), jnp.asarray(table[2]))

    def advance(
        self, state: SurrogateState, command: Command, ticks: int
    ) -> tuple[SurrogateState, Reading]:
        """Hold the command for `ticks` samples, computed as one batch per network; raises
        CommandError if the command is outside the limits."""
        check_commands(self.limits, command)
        return self._held(state, command, ticks, ticks)

    def hold_action(
        self, state: SurrogateState, command: Command, ticks: Ticks, rows: int
    ) -> tuple[SurrogateState, Reading]:
        """Hold the command for an action, computed as a batch of the fixed size `rows`."""
        return self._held(state, command, rows, ticks)

    def _held(
        self, state: SurrogateState, command: Command, rows: int, ticks: Ticks
    ) -> tuple[SurrogateState, Reading]:
        """Return readings with a fixed number of rows; the first `ticks` rows are valid."""
        # Window k ends with the k-th held command and the angle at which it was issued. From this
        # window, the networks predict the angle and force one sample later.
        #
        # With w = window and n = rows, the shapes are: commands (2, w + n), passed (n, 2, w),
        # angles (w + n), motion (n, 3, w).
        held = jnp.tile(self._scaled(command)[:, None], rows)
        commands = jnp.concatenate([state.commands, held], axis=1)
        passed = windows(commands[:, 1:], self.window)
        angles = jnp.concatenate([state.angles, self.posnet(passed)[:, 0]])
        motion = jnp.concatenate([windows(angles[None, :-1], self.window), passed], axis=1)
        force = self.scaling.physical(FORCES, self.forcenet(motion))
        # The velocity is (angle[k] - angle[k - 1]) / 10 ms, so one earlier angle is needed.
        angle = self.scaling.physical([ANGLE], angles[-rows - 1 :, None])[:, 0]
        time = (state.tick + 1 + jnp.arange(rows)) * jnp.float32(TICK_S)
        reading = Reading(time, angle[1:], jnp.diff(angle) * RATE_HZ, force)
        # The new state contains the window that ends at the last valid row.
        commands = jax.lax.dynamic_slice_in_dim(commands, ticks, self.window, -1)
        angles = jax.lax.dynamic_slice_in_dim(angles, ticks, self.window, -1)
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
        """Return PosNet's predictions for the rows of a log after the first window [rad]."""
        angle = self.posnet.over_table(self.scaling.table(COMMAND_COLUMNS, log))
        return np.asarray(self.scaling.physical([ANGLE], angle))[:, 0]

    def predict_force(self, log: Log, free_running: bool) -> Float[np.ndarray, "predicted 2"]:
        """Return ForceNet's predictions for the rows of a log after the first window [N].

        The input is the measured angle, or the angle predicted by PosNet if `free_running` is set.
        """
        table = self.scaling.table((ANGLE, *COMMAND_COLUMNS), log)
        if free_running:
            # The first window keeps the measured angle, because PosNet does not predict it.
            table[self.window :, 0] = self.posnet.over_table(table[:, 1:])[:, 0]
        return np.asarray(self.scaling.physical(FORCES, self.forcenet.over_table(table)))

    def predictions(self, logs: Sequence[Log]) -> dict[str, NetPrediction]:
        """Predict logs with PosNet, and with ForceNet from measured and from predicted angles."""
        window = self.window
        posnet = self.posnet.config.parameters()
        forcenet = self.forcenet.config.parameters()
        angle = []
        measured = []
        free = []
        for log in logs:
            angle.append(self.predict_angle(log)[:, None])
            measured.append(self.predict_force(log, free_running=False))
            free.append(self.predict_force(log, free_running=True))
        return {
            "posnet": NetPrediction("PosNet, commands to angle", (ANGLE,), angle, window, posnet),
            "forcenet_measured": NetPrediction(
                "ForceNet, given the measured angle", FORCES, measured, window, forcenet
            ),
            "forcenet_free_running": NetPrediction(
                "ForceNet, free-running behind PosNet", FORCES, free, window, forcenet
            ),
        }

    def parameters(self) -> int:
        """Return the number of trainable parameters of both networks."""
        return self.posnet.config.parameters() + self.forcenet.config.parameters()

    def to_files(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the entries of ``surrogate.json`` and the weights by name, e.g.
        ``posnet.3.kernel``."""
        posnet = self.posnet.config
        forcenet = self.forcenet.config
        description = {
            "networks": {
                "posnet": posnet.model_dump(mode="json"),
                "forcenet": forcenet.model_dump(mode="json"),
            },
            "parameters": {"posnet": posnet.parameters(), "forcenet": forcenet.parameters()},
            "scaling": self.scaling.model_dump(mode="json")["channels"],
        }
        layers = {"posnet": self.posnet.layers, "forcenet": self.forcenet.layers}
        return description, name_net_arrays(layers)

    @classmethod
    def from_files(
        cls, description: JsonObject, weights: dict[str, np.ndarray], source: str
    ) -> "Surrogate":
        """Build the surrogate from the result of `to_files`.

        Raises:
            ArtifactError: If channels or weights do not match the networks.
        """
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
    """Return all windows of a series, oldest first; ``count = samples - window + 1``."""
    count = series.shape[1] - window + 1
    rows = jnp.arange(count)[:, None] + jnp.arange(window)
    return jnp.swapaxes(series[:, rows], 0, 1)
