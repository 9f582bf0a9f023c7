"""Active excitation: the commands whose force the members of an ensemble agree on least, for the next log of the fin.

A log is a chain of pieces. For each, many random sequences of commands are rolled through the ensemble side by side,
from the state that the pieces before have led to, and the one with the greatest score is taken:

    sum over its windows and both axes of  log(1 + var / noise^2) / 2,  times  unlikeness ** novelty

with var the variance over the members of the force's mean over a window. The first factor is the information in a
reading of a Gaussian with that variance through noise (Shannon; Lindley 1956, Ann. Math. Stat. 27:986). Unlikeness is
how far the piece's windows are from those already taken, in the memory of the first member's force network.
"""

import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.data.collect import CollectConfig
from softfin.data.excitation import Commands, ExcitationConfig
from softfin.storage import artifact as artifacts
from softfin.surrogate.store import load_surrogate
from softfin.surrogate.streaming.ensemble import remembered, single
from softfin.surrogate.streaming.streaming import StreamingState, StreamingSurrogate

KNOWN = 0.5
"""Least share of the plant's range of commands that an ensemble must have learnt from: else it means little."""


class ActiveConfig(Configuration):
    """How the commands are chosen."""

    candidates: pydantic.PositiveInt = 32
    """Sequences that each piece is chosen from; one is random excitation."""
    piece_s: float = pydantic.Field(default=2.0, gt=0)
    """Length of a piece [s]: a few strokes, so that a sequence can lead to where the members disagree."""
    window_s: float = pydantic.Field(default=0.25, gt=0)
    """Length of the windows of the compared mean forces [s]: whole samples, and a whole number of them a piece."""
    noise_n: float = pydantic.Field(default=0.05, gt=0)
    """Noise of such a mean [N]: disagreement far above it counts by its logarithm only, so that no single stroke
    outweighs all others; a great value makes it count by its square."""
    novelty: float = pydantic.Field(default=0.5, ge=0)
    """Exponent of the unlikeness; 0 leaves it out."""

    @pydantic.model_validator(mode="after")
    def _in_whole_numbers(self) -> "ActiveConfig":
        parts = np.array([self.window_s * RATE_HZ, self.piece_s / self.window_s])
        if (np.abs(parts - np.round(parts)) > 1e-6).any() or (parts < 0.5).any():
            raise ValueError("window_s must be whole samples of 10 ms, and piece_s whole windows, such as 0.25 and 2")
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """Windows of a piece, and ticks of a window."""
        return round(self.piece_s / self.window_s), round(self.window_s * RATE_HZ)


class ActiveCollectConfig(CollectConfig):
    """How much is recorded, under commands that an ensemble chooses."""

    active: ActiveConfig = ActiveConfig()
    """How the commands are chosen among random ones, which `excitation` describes."""

    @pydantic.model_validator(mode="after")
    def _holds_fit_pieces(self) -> "ActiveCollectConfig":
        if (piece_s := self.active.piece_s) < (hold_s := self.excitation.hold_min_s):
            raise ValueError(f"active.piece_s = {piece_s:g} must be at least excitation.hold_min_s = {hold_s:g}")
        return self


class Chooser(eqx.Module):
    """Makes the commands of a log (`Commands`): the same key gives the same ones."""

    ensemble: StreamingSurrogate
    config: ActiveConfig = eqx.field(static=True)
    excitation: ExcitationConfig = eqx.field(static=True)

    def __call__(self, key: PRNGKeyArray, rows: int, limits: Limits) -> Command:
        """Choose one command a tick, fields ``(rows,)``, from rest on; pure and traceable."""
        config, (windows, ticks) = self.config, self.config.shape
        pieces = -(-rows // (windows * ticks))
        # Memories at the ends of the windows taken so far; infinite where no piece is yet.
        nowhere = jnp.full((pieces, windows, self.ensemble.familiarity.mean.size), jnp.inf)

        def piece(chain: tuple[StreamingState, Array], index: Array) -> tuple[tuple[StreamingState, Array], Command]:
            before, visited = chain
            keys = jax.random.split(jax.random.fold_in(key, index), config.candidates)
            commands = jax.vmap(lambda key: self._sequence(key, limits))(keys)
            states, (forces, memories) = jax.vmap(self._roll, in_axes=(None, 0))(before, commands)
            informative = jax.vmap(lambda force: information(force, config.noise_n))(forces)
            unlike = jax.vmap(lambda memory: unlikeness(memory, visited))(memories)
            best = jnp.argmax(informative * unlike**config.novelty)
            state, memory, command = jax.tree.map(lambda x: x[best], (states, memories, commands))
            return (state, visited.at[index].set(memory)), command

        _, chosen = jax.lax.scan(piece, (self.ensemble.init(key), nowhere), jnp.arange(pieces))
        return Command(*(channel.reshape(-1)[:rows] for channel in chosen))

    def _sequence(self, key: PRNGKeyArray, limits: Limits) -> Command:
        """Random commands, but for the last, which is held for the shortest hold at least."""
        ticks = math.prod(self.config.shape)
        random = self.excitation(key, ticks, limits)
        kept = jnp.minimum(jnp.arange(ticks), ticks - round(self.excitation.hold_min_s * RATE_HZ))
        return Command(random.angle[kept], random.velocity[kept])

    def _roll(self, state: StreamingState, commands: Command) -> tuple[StreamingState, tuple[Array, Array]]:
        """Mean forces over a piece's windows, of each member [N], and memories at their ends in units of distance."""

        def tick(state: StreamingState, command: Command) -> tuple[StreamingState, Array]:
            state, each = self.ensemble.advance_members(state, command, 1)
            return state, jnp.asarray(each.force[:, 0])

        def window(state: StreamingState, commands: Command) -> tuple[StreamingState, tuple[Array, Array]]:
            state, force = jax.lax.scan(tick, state, commands)
            memory = remembered(single(state.members.force)) @ self.ensemble.familiarity.whitening
            return state, (force.mean(0), memory)

        parts = jax.tree.map(lambda x: x.reshape(self.config.shape), commands)
        return jax.lax.scan(window, state, parts)


def information(force: Float[Array, "windows members 2"], noise_n: float) -> Float[Array, ""]:
    """Information in readings of these means through noise [nat], were each mean by itself."""
    return jnp.log1p(force.var(axis=1) / noise_n**2).sum() / 2


def unlikeness(
    memory: Float[Array, "windows remembered"], visited: Float[Array, "pieces windows remembered"]
) -> Float[Array, ""]:
    """Mean distance of a piece's windows to the nearest that was visited; 1 where none was yet."""
    nearest = jnp.linalg.norm(memory[:, None, None] - visited, axis=-1).min(axis=(1, 2))
    return jnp.where(jnp.isfinite(nearest), nearest, 1.0).mean()


def chooser(folder: Path, config: ActiveCollectConfig, limits: Limits) -> tuple[Commands, dict[str, Any]]:
    """Load the ensemble that chooses for a plant with these limits; also its entries of the dataset's description."""
    surrogate = load_surrogate(folder)
    if not isinstance(surrogate, StreamingSurrogate) or surrogate.size < 2:
        raise ConfigurationError(f"{folder}: a {surrogate.model} surrogate; active excitation needs members that can "
                                 "disagree: fit one with --model streaming and at least 2 members")  # fmt: skip
    for name, unit, low, high in (("angle", "rad", 0, 1), ("velocity", "rad/s", 2, 3)):
        learnt, plant = ((ends[low], ends[high]) for ends in (surrogate.limits, limits))
        span, common = plant[1] - plant[0], min(learnt[1], plant[1]) - max(learnt[0], plant[0])
        if max(plant[0] - learnt[0], learnt[1] - plant[1]) > 1e-3 * span or common < KNOWN * span:
            raise ConfigurationError(
                f"{folder}: learnt from commands with {name}s of {learnt[0]:.3g} .. {learnt[1]:.3g} {unit}, where the "
                f"plant takes {plant[0]:.3g} .. {plant[1]:.3g}; it must have learnt from at least {KNOWN:.0%} of that "
                "and nothing beyond: fit it to random logs of this plant"
            )
    provenance = artifacts.load_description(folder, "surrogate").get("provenance") or {}
    metadata = {"surrogate": str(folder), "members": surrogate.size, "data_hash": provenance.get("data_hash")}
    return Chooser(surrogate, config.active, config.excitation), metadata
