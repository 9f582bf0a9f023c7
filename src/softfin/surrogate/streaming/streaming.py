"""An ensemble of streaming networks as a `Plant`, from commands to readings at 100 Hz, with error
estimates."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.compilation import jit
from softfin.core.errors import ArtifactError
from softfin.core.json_object import JsonObject
from softfin.core.plant import check_commands, check_key, rest_command
from softfin.core.quantities import TICK_S, AnyArray, Command, Limits, Log, Reading, tick_at
from softfin.surrogate.channels import (
    ANGLE,
    COMMAND_COLUMNS,
    FORCES,
    READINGS,
    SKIPPED,
    NetPrediction,
)
from softfin.surrogate.streaming.ensemble import (
    Familiarity,
    Interval,
    Member,
    MemberState,
    PowerInterval,
    ensemble,
    parameters,
    predict_force,
    predict_motion,
    remembered,
    single,
)
from softfin.surrogate.streaming.nets import DriveNetConfig, ForceNetConfig, ForceState
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, Scales
from softfin.surrogate.streaming.torque import (
    TORQUE,
    power_means,
    replace_torque,
    with_torque,
)
from softfin.surrogate.training import check_history, name_net_arrays, restored

SETTLED = 3000
"""Duration of the rest before `init` [ticks]: 20 times the longest initial time constant of the
wake."""


def _channels(has_torque: bool) -> JsonObject:
    torque = [TORQUE] if has_torque else []
    return {"in": list(COMMAND_COLUMNS), "out": [*READINGS, *torque]}


class StreamingState(NamedTuple):
    """State of an ensemble; its size is constant over time."""

    tick: Int[Array, ""]
    """Time since the start [10 ms]."""
    members: MemberState
    """Stacked states of the members."""


class StreamingSurrogate(eqx.Module):
    """An ensemble whose readings are the mean of its members; implements `EnsemblePlant`."""

    members: Member
    """Stacked members."""
    rest: MemberState
    """Stacked states of the members after a long rest."""
    familiarity: Familiarity
    interval: Interval = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """Range of the commands in the training data; the networks extrapolate outside it."""
    power_interval: PowerInterval | None = eqx.field(static=True)
    """Interval of the mean power; None if the torque is unknown."""

    computed: ClassVar[tuple[str, ...]] = ("rest",)
    """Names of the fields that are computed from other fields."""
    optional: ClassVar[tuple[str, ...]] = ("power_interval",)
    """Names of the fields that do not change the identity if they are None."""
    model: ClassVar[str] = "streaming"
    memory: ClassVar[int] = 300
    """Number of rows of a log that `warm` needs: the duration of a stroke at the paper's lowest
    velocity."""
    scaling: ClassVar[None] = None

    def __init__(
        self,
        members: Member,
        limits: Limits,
        interval: Interval,
        familiarity: Familiarity,
        power_interval: PowerInterval | None = None,
    ) -> None:
        self.members = members
        self.limits = limits
        self.interval = interval
        self.familiarity = familiarity
        self.power_interval = power_interval
        command = rest_command(limits)
        waiting = jax.tree.map(lambda value: jnp.full(MAX_DELAY, value), command)
        passed = jax.tree.map(lambda value: jnp.full(SETTLED, value), command)
        self.rest = _after(members, Motion(command.angle, jnp.zeros(())), waiting, passed)

    @property
    def size(self) -> int:
        """Number of members."""
        return int(self.members.force.offset.shape[0])

    @property
    def mean_force_noise_n(self) -> float:
        """Root mean square error of the mean force on the held-out logs [N], due to noise, drift
        and the fit."""
        return self.interval.floor_n

    def init(self, key: PRNGKeyArray) -> StreamingState:
        """Return the state after a long rest. The key is not used."""
        check_key(key)
        return StreamingState(jnp.int32(0), self.rest)

    def warm(self, history: Log) -> StreamingState:
        """Return the state after a free run over the last `memory` rows of a recorded history.

        Raises:
            LogError: If the history is too short.
        """
        check_history(history, self.memory)
        command, reading = jax.tree.map(
            lambda part: jnp.asarray(part[-self.memory :], jnp.float32),
            (history.command, history.reading),
        )
        # The first MAX_DELAY rows only fill the queue of commands; the free run starts after them.
        motion = Motion(reading.angle[MAX_DELAY], reading.velocity[MAX_DELAY])
        waiting = jax.tree.map(lambda part: part[:MAX_DELAY][::-1], command)
        # The command of the last row affects only the next row, so it is passed to the next call of
        # `advance`.
        passed = jax.tree.map(lambda part: part[MAX_DELAY:-1], command)
        tick = tick_at(float(history.reading.time[-1]))
        return StreamingState(jnp.int32(tick), _after(self.members, motion, waiting, passed))

    def advance(
        self, state: StreamingState, command: Command, ticks: int
    ) -> tuple[StreamingState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and return a reading after each sample,
        with fields ``(ticks,)``."""
        state, each = self.advance_members(state, command, ticks)
        return state, Reading(each.time[0], *(channel.mean(axis=0) for channel in each[1:]))

    def advance_members(
        self, state: StreamingState, command: Command, ticks: int
    ) -> tuple[StreamingState, Reading]:
        """Like `advance`, but return the readings of all members, with fields ``(members, ticks)``;
        raises CommandError if the command is outside the limits."""
        check_commands(self.limits, command)
        held = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), command)

        def one(member: Member, own: MemberState) -> tuple[MemberState, tuple[Motion, Array]]:
            return jax.lax.scan(lambda each, _: member.step(each, held), own, length=ticks)

        after, (motion, force) = jax.vmap(one)(self.members, state.members)
        time = (state.tick + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        reading = Reading(
            jnp.broadcast_to(time, (self.size, ticks)), motion.angle, motion.velocity, force
        )
        return StreamingState(state.tick + ticks, after), reading

    def torque(self, state: StreamingState) -> Float[Array, "2"] | None:
        """Return the predicted torque on the fin in the last tick [N m], and NaN for the motor;
        None if the logs did not contain the torque."""
        coefficients = self.members.force.torque
        if coefficients is None:
            return None
        features = jax.vmap(ForceState.odd_features)(state.members.force)
        return jnp.stack([(coefficients * features).sum(axis=1).mean(), jnp.float32(jnp.nan)])

    def distance(self, state: StreamingState) -> Float[Array, ""]:
        """Return the distance of the recent motion from the training data; for 1 in 1000 training
        samples, it exceeds 1."""
        return self.familiarity.distance(remembered(single(state.members.force)))

    def predictions(self, logs: Sequence[Log]) -> dict[str, NetPrediction]:
        """Return the mean predictions of the ensemble for logs, by the drive networks and by the
        force networks from measured and from predicted motion."""
        drive = self.members.drive
        force = self.members.force
        free = predict_motion(drive, logs)
        measured = []
        for log in logs:
            channels = np.stack([log.reading.angle, log.reading.velocity])
            # Every member gets the same measured motion: (channels, members, rows).
            measured.append(Motion(*np.tile(channels[:, None], (self.size, 1))))
        angle = [motion.angle[..., None] for motion in free]

        def average(series: Sequence[AnyArray]) -> list[np.ndarray]:
            return [np.mean(members, axis=0)[SKIPPED:] for members in series]

        force_given = average(predict_force(force, measured))
        force_free = average(predict_force(force, free))
        return {
            "drive": NetPrediction(
                "Drive networks, commands to angle",
                (ANGLE,),
                average(angle),
                None,
                parameters(drive),
            ),
            "force_measured": NetPrediction(
                "Force networks, given the measured motion",
                FORCES,
                force_given,
                None,
                parameters(force),
            ),
            "force_free_running": NetPrediction(
                "Force networks, free-running behind the drive networks",
                FORCES,
                force_free,
                None,
                parameters(force),
            ),
        }

    def power_scores(self, logs: Sequence[Log]) -> JsonObject | None:
        """Return the root mean square error of the predicted mean power over 2 s [W], the mean
        power [W], the fraction of means inside the interval and the number of logs; None without
        the torque."""
        recorded = with_torque(predict_motion(self.members.drive, logs), logs)
        if self.power_interval is None or not recorded:
            return None
        means, measured = power_means(self.members.force, recorded, SKIPPED)
        error = np.abs(means.mean(axis=0) - measured)
        return {
            "rmse_w": float(np.sqrt(np.mean(error**2))),
            "mean_w": float(measured.mean()),
            "coverage": float((error <= self.power_interval.half_width(means)).mean()),
            "logs": len(recorded),
        }

    def parameters(self) -> int:
        """Return the number of trainable parameters of all members."""
        return parameters(self.members)

    def to_files(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the entries of ``surrogate.json``, and the arrays by path."""
        drive = self.members.drive
        force = self.members.force
        interval = self.power_interval
        power = {} if interval is None else {"power_interval": interval.model_dump(mode="json")}
        return {
            "channels": _channels(interval is not None),
            "members": self.size,
            "networks": {
                "drive": drive.config.model_dump(mode="json"),
                "force": force.config.model_dump(mode="json"),
            },
            "scales": force.scales.model_dump(mode="json"),
            "interval": self.interval.model_dump(mode="json"),
            **power,
            "parameters": self.parameters(),
        }, name_net_arrays({"members": self.members, "familiarity": self.familiarity})

    def explorer_data(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the data for the explorer script: the networks, and the state of the members after
        a long rest."""
        description, arrays = self.to_files()
        entries = {name: description[name] for name in ("members", "scales", "interval")}
        return entries, arrays | name_net_arrays({"rest": self.rest})

    @classmethod
    def from_files(
        cls, description: JsonObject, weights: dict[str, np.ndarray], source: str
    ) -> "StreamingSurrogate":
        """Build the surrogate from the result of `to_files`.

        Raises:
            ArtifactError: If channels or arrays do not match the networks.
        """
        power = description.get("power_interval")
        power_interval = None if power is None else PowerInterval.model_validate(power)
        channels = _channels(power is not None)
        if description["channels"] != channels:
            raise ArtifactError(
                f"{source}: unsupported channels {description['channels']}; this streaming "
                f"surrogate must have {channels}"
            )
        drive = DriveNetConfig.build(description["networks"]["drive"], f"{source}: networks.drive")
        force = ForceNetConfig.build(description["networks"]["force"], f"{source}: networks.force")
        scales = Scales.model_validate(description["scales"])
        size = int(description["members"])

        # Only the shapes are evaluated; the weights are replaced, so they need not be computed.
        def skeleton() -> dict[str, Any]:
            memory = 2 * (force.units + force.wake)
            familiarity = Familiarity(jnp.zeros(memory), jnp.zeros((memory, memory)))
            members = ensemble(size, drive, force, scales, jax.random.key(0))
            if power is not None:
                coefficients = jnp.zeros((size, force.odd_features))
                members = eqx.tree_at(
                    lambda each: each.force, members, replace_torque(members.force, coefficients)
                )
            return {
                "members": members,
                "familiarity": familiarity,
            }

        trees = restored(eqx.filter_eval_shape(skeleton), weights, source)
        limits = Limits.of(description["limits"])
        interval = Interval.model_validate(description["interval"])
        return cls(trees["members"], limits, interval, trees["familiarity"], power_interval)


@jit("none")
def _after(members: Member, motion: Motion, waiting: Command, passed: Command) -> MemberState:
    """Return the states of the members after the commands `passed`, one per tick."""

    def one(member: Member) -> Any:
        return jax.lax.scan(
            lambda state, now: member.step(state, now), member.start(motion, waiting), passed
        )[0]

    state: MemberState = eqx.filter_vmap(one)(members)
    return state
