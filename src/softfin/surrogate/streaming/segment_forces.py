"""Forces in a batch of segments, with an efficient gradient; used to train force networks.

The loop over the ticks contains only the memory and the wake. The rates of the motion are computed
before the loop, and the forces after it. The gradient with respect to a matrix is the sum over all
ticks of x^T d, where x is the vector that the matrix multiplies and d is the gradient with respect
to the product. Automatic differentiation computes these small matrices one by one and adds them.
Here, the loop returns d for all ticks, and one large product replaces the sum.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.surrogate.streaming.nets import (
    ForceNet,
    Parity,
    magnitude,
    relax,
    rotate,
    update_memory,
)
from softfin.surrogate.streaming.segments import Motion


class Products(NamedTuple):
    """One array for each matrix product in the loop: the matrix, the input or the result."""

    mixed: Float[Array, "*mixed"]
    """Odd candidates and mixtures; inputs: odd memory and wake."""
    gates: Float[Array, "*gates"]
    """Gates; inputs: even memory, wake and magnitudes of the mixtures."""
    along: Float[Array, "*wake"]
    """Targets of the wake along the fin; input: new even memory."""
    across: Float[Array, "*wake"]
    """Targets of the wake across the fin; input: new odd memory."""


class LoopTerms(NamedTuple):
    """Arguments of the loop that depend only on the motion, ``(ticks, batch, ...)``."""

    added: Products
    """Terms that are added to the products. The gradient with respect to a term is equal to the
    gradient with respect to the product."""
    cos: Float[Array, "ticks batch 1"]
    """Cosine of the angle by which the wake rotates in the frame of the fin."""
    sin: Float[Array, "ticks batch 1"]


class LoopState(NamedTuple):
    """State of the loop, ``(batch, ...)``."""

    memory: Parity
    wake: Parity


class Recording(NamedTuple):
    """Results of the loop, ``(ticks, batch, ...)``."""

    memory: Parity
    sizes: Float[Array, "ticks batch units"]
    """Magnitudes of the mixtures."""
    wake: Parity
    """Wake vectors after their rotation."""


Residuals: TypeAlias = tuple[Callable[[Recording], Any], Recording]
"""Values that the gradient needs: the gradient function of the loop, and its recording."""


def segment_forces(net: ForceNet, motion: Motion) -> Float[Array, "batch ticks 2"]:
    """Predict the forces for all rows of the motions ``(batch, 1 + ticks)`` except the first [N].

    The results are equal to `softfin.surrogate.streaming.ensemble.forces` for each motion.
    """
    by_tick = jax.tree.map(jnp.transpose, motion)
    before = jax.tree.map(lambda x: x[:-1], by_tick)
    after = jax.tree.map(lambda x: x[1:], by_tick)
    rates = net.rates(before, after)
    units = net.core.units
    memory_rows, rate_rows, wake_rows = jnp.split(net.core.odd_in, [units, units + rates.shape[-1]])
    mixed_matrix = jnp.concatenate([memory_rows, wake_rows])
    matrices = Products(mixed_matrix, net.core.even_in, net.along, net.across)
    nothing = jnp.zeros((*rates.shape[:2], net.config.wake))
    bias = jnp.broadcast_to(net.core.bias, (*rates.shape[:2], net.core.bias.size))
    added = Products(rates @ rate_rows, bias, nothing, nothing)
    turn = (before.angle - after.angle)[..., None]
    terms = LoopTerms(added, jnp.cos(turn), jnp.sin(turn))
    recording = _record(matrices, net.kept(), terms)
    outputs = jax.vmap(jax.vmap(net.core.read))(recording.memory, recording.sizes)
    force = jax.vmap(jax.vmap(net.force))(outputs, rates, after.angle)
    return jnp.swapaxes(force, 0, 1)


@jax.custom_vjp
def _record(matrices: Products, kept: Float[Array, "wake"], terms: LoopTerms) -> Recording:
    return _loop(matrices, kept, terms)


def _loop(matrices: Products, kept: Float[Array, "wake"], terms: LoopTerms) -> Recording:
    """Advance memory and wake tick by tick, as `ForceNet.step` does."""

    def step(state: LoopState, now: LoopTerms) -> tuple[LoopState, Recording]:
        memory, wake = state
        wake = rotate(wake, now.cos, now.sin)
        mixed = jnp.concatenate([memory.odd, wake.odd], axis=-1) @ matrices.mixed
        candidates, mixtures = jnp.split(mixed + now.added.mixed, 2, axis=-1)
        sizes = magnitude(mixtures)
        gates = jnp.concatenate([memory.even, wake.even, sizes], axis=-1) @ matrices.gates
        memory = update_memory(memory, candidates, gates + now.added.gates)
        along = memory.even @ matrices.along + now.added.along
        across = memory.odd @ matrices.across + now.added.across
        relaxed = relax(wake, Parity(along, across), kept)
        return LoopState(memory, relaxed), Recording(memory, sizes, wake)

    batch = terms.cos.shape[1]
    no_memory = jnp.zeros((batch, matrices.along.shape[0]))
    still = jnp.zeros((batch, kept.size))
    start = LoopState(Parity(no_memory, no_memory), Parity(still, still))
    # For the gradient, the values within a tick are recomputed, which is faster than storing and
    # loading them.
    recording: Recording = jax.lax.scan(jax.checkpoint(step, prevent_cse=False), start, terms)[1]
    return recording


def _forward(
    matrices: Products, kept: Float[Array, "wake"], terms: LoopTerms
) -> tuple[Recording, Residuals]:
    """Run the loop and differentiate it as if the matrices were constants."""
    recording, pull = jax.vjp(partial(_loop, matrices), kept, terms)
    return recording, (pull, recording)


def _backward(
    residuals: Residuals, slope: Recording
) -> tuple[Products, Float[Array, "wake"], LoopTerms]:
    """Return the gradients with respect to the arguments of `_record`."""
    pull, recording = residuals
    kept, terms = pull(slope)
    before = jax.tree.map(_previous, recording.memory)
    wake = recording.wake
    inputs = Products(
        mixed=jnp.concatenate([before.odd, wake.odd], axis=-1),
        gates=jnp.concatenate([before.even, wake.even, recording.sizes], axis=-1),
        along=recording.memory.even,
        across=recording.memory.odd,
    )
    matrices = jax.tree.map(partial(jnp.einsum, "tbi,tbo->io"), inputs, terms.added)
    return matrices, kept, terms


def _previous(memory: Float[Array, "ticks batch units"]) -> Float[Array, "ticks batch units"]:
    """Return the memory before each tick, which is empty before the first."""
    return jnp.concatenate([jnp.zeros_like(memory[:1]), memory[:-1]])


_record.defvjp(_forward, _backward)
