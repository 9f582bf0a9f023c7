"""The surrogate: PosNet and ForceNet as a Plant, commands in and readings out at 100 Hz (paper Sec. III-C1).

    command ──> last 100 commands ──> PosNet ──> angle ──> last 100 angles ─┐
                        └───────────────────────────────────────────────────┴──> ForceNet ──> force

A held command lets all ticks of an action go through each net at once: PosNet sees commands alone, and ForceNet sees
angles that PosNet has then said already. Only the new ticks are computed.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.action_clock import MOST_TICKS
from softfin.core.errors import ArtifactError, LogError
from softfin.core.plant import Ticks, rest_command
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits, Log, Reading
from softfin.core.ticks import tick_at
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.network import Network
from softfin.surrogate.paper.posnet import COMMANDS
from softfin.surrogate.paper.scaling import Scaling

ANGLE = "angle_rad"


class SurrogateState(NamedTuple):
    """The last second, scaled; the newest sample last."""

    tick: Int[Array, ""]
    """Since the start [10 ms]."""
    commands: Float[Array, "2 window"]
    angles: Float[Array, "window"]


class Surrogate(eqx.Module):
    """A learnt fin; meets the Plant contract."""

    model: ClassVar[str] = "paper"
    """Among the kinds of surrogates."""

    posnet: Network
    forcenet: Network
    scaling: Scaling = eqx.field(static=True)

    def __check_init__(self) -> None:
        seen = self.posnet.config.window, self.forcenet.config.window
        if seen[0] != seen[1]:
            raise ArtifactError(f"PosNet sees {seen[0]} samples and ForceNet {seen[1]}; both must see the same window")

    @property
    def window(self) -> int:
        """Samples of the past that both nets see."""
        return self.posnet.config.window

    @property
    def memory(self) -> int:
        """Rows of a log that `warm` needs."""
        return self.window

    @property
    def limits(self) -> Limits:
        """The range of the commands in the training data: beyond it the nets extrapolate."""
        angle, velocity = (self.scaling.channels[name] for name in COMMANDS)
        return Limits(angle.data_min, angle.data_max, velocity.data_min, velocity.data_max)

    def init(self, key: PRNGKeyArray) -> SurrogateState:
        """At rest at angle 0 for longer than the window. Nothing is random here: the key is not used."""
        rest = self._scaled(rest_command(self.limits))
        angle = jnp.full(self.window, self.scaling.scaled(ANGLE, jnp.float32(0)))
        return SurrogateState(jnp.int32(0), jnp.tile(rest[:, None], self.window), angle)

    def warm(self, history: Log) -> SurrogateState:
        """As if the fin had been followed through a recording: the next tick says row ``len(history)`` of the log.

        That tick is given the command of the last row, as the log's order wants it. Only the last `memory` rows matter;
        raises LogError where there are fewer.
        """
        rows = len(history.reading.time)
        if rows < self.memory:
            raise LogError(f"{rows} rows of history; a surrogate that sees {self.memory} samples is warm after as many")
        seen = slice(rows - self.window, rows)
        table = np.stack([self.scaling.scaled(n, c[seen]) for n, c in zip(COMMANDS, history.command, strict=True)])
        # The last row's command is yet to be given; the oldest of the state's leaves before it is looked at.
        commands = np.concatenate([table[:, :1], table[:, :-1]], axis=1)
        angles = self.scaling.scaled(ANGLE, history.reading.angle[seen])
        tick = tick_at(float(history.reading.time[-1]))
        return SurrogateState(jnp.int32(tick), jnp.asarray(commands, jnp.float32), jnp.asarray(angles, jnp.float32))

    def advance(self, state: SurrogateState, command: Command, ticks: int) -> tuple[SurrogateState, Reading]:
        """Hold the command for `ticks` samples; all of them go through each net as one batch."""
        return self._held(state, command, ticks, ticks)

    def hold_action(self, state: SurrogateState, command: Command, ticks: Ticks) -> tuple[SurrogateState, Reading]:
        """The same for an action, as one batch of the longest."""
        return self._held(state, command, MOST_TICKS, ticks)

    def _held(self, state: SurrogateState, command: Command, rows: int, ticks: Ticks) -> tuple[SurrogateState, Reading]:
        """So many rows, of which the first `ticks` count."""
        held = jnp.tile(self._scaled(command)[:, None], rows)
        commands = jnp.concatenate([state.commands, held], axis=1)
        seen = windows(commands[:, 1:], self.window)
        fresh = self.posnet(seen)[:, 0]
        angles = jnp.concatenate([state.angles, fresh])
        motion = jnp.concatenate([windows(angles[None, :-1], self.window), seen], axis=1)
        force = self.scaling.physical(FORCES, self.forcenet(motion))

        angle = self.scaling.physical([ANGLE], angles[-rows - 1 :, None])[:, 0]
        time = (state.tick + 1 + jnp.arange(rows)) * jnp.float32(TICK_S)
        reading = Reading(time, angle[1:], jnp.diff(angle) * RATE_HZ, force)
        commands, angles = (jax.lax.dynamic_slice_in_dim(x, ticks, self.window, -1) for x in (commands, angles))
        return SurrogateState(state.tick + ticks, commands, angles), reading

    def _scaled(self, command: Command) -> Float[Array, "2"]:
        return jnp.stack([self.scaling.scaled(name, value) for name, value in zip(COMMANDS, command, strict=True)])

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin."""
        return self.posnet.config.flops() + self.forcenet.config.flops()

    def parameters(self) -> int:
        """Trainable numbers of both nets."""
        return self.posnet.config.parameters() + self.forcenet.config.parameters()


def windows(series: Float[Array, "channels samples"], window: int) -> Float[Array, "count channels window"]:
    """Every run of `window` samples, the oldest first: ``count = samples - window + 1``."""
    count = series.shape[1] - window + 1
    rows = jnp.arange(count)[:, None] + jnp.arange(window)
    return jnp.swapaxes(series[:, rows], 0, 1)
