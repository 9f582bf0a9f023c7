"""Gaits for a whole lattice of reference forces at once, in one compiled program.

Mean force and Sobolev term of a gait are smooth functions of its twelve numbers, and the plant gives their derivatives.
Two of the twelve directions change the force; Gauss-Newton steps along these bring it to the reference, while the other
ten lower the Sobolev term and keep each gait near those of its neighbours, so that gaits in between may be blended
(null-space projection, as for redundant manipulators: Siciliano and Khatib, Handbook of Robotics, Sec. 10.3).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.configuration import Configuration
from softfin.core.plant import Plant
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AnyArray
from softfin.core.randomness import key_of
from softfin.gaits.simulate import CYCLES, Response, raw_of, response
from softfin.gaits.survey import Survey
from softfin.task.references import Cell, Force


class GaitConfig(Configuration):
    """How gaits are found."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Windows that a gait is repeated for from rest; the last one counts. The fin and its wake must settle before."""
    steps: PositiveInt = 24
    """Gauss-Newton steps; the last `EXACT` of them look at the force alone."""
    smoothness: NonNegativeFloat = 0.05
    """Weight of the Sobolev term (form `mean`) among what the force leaves open."""
    likeness: NonNegativeFloat = 0.6
    """Weight of the distance to the mean of the neighbours, squared."""


class Lattice(NamedTuple):
    """References that gaits are found for."""

    low: Force
    """Lower corner (x, y) [N]."""
    high: Force
    nodes: tuple[int, int]
    """In x and y, 2 or more."""

    @classmethod
    def over(cls, box: Cell, spacing_n: float) -> "Lattice":
        """Nodes at most `spacing_n` apart, with the corners of the box among them."""
        counts = [max(2, math.ceil((b - a) / spacing_n - 1e-6) + 1) for a, b in zip(box.low, box.high, strict=True)]
        return cls(box.low, box.high, (counts[0], counts[1]))

    def table(self) -> "GaitTable":
        """Of which every action is 0."""
        low, high = (jnp.asarray(corner, jnp.float32) for corner in (self.low, self.high))
        return GaitTable(low, high, jnp.zeros((*self.nodes, CYCLE_ACTIONS, 2)))


EXACT = 5
"""Last steps, without any but the force to please."""

MISSED_N = 0.05
"""A node further from its force than this begins again where a neighbour is."""

FORCE_STEP, FREE_STEP = 0.6, 0.25
"""Longest steps in the atanh of the actions, along the force and across."""


class GaitTable(NamedTuple):
    """Gaits on a lattice of references; in between they are blended."""

    low: Float[Array, "2"]
    """Corners of the lattice (x, y) [N]."""
    high: Float[Array, "2"]
    actions: Float[Array, "x y 6 2"]
    """In [-1, 1], (angle, velocity) over the plant's limits."""

    def gait(self, reference: Float[Array, "2"]) -> Float[Array, "6 2"]:
        """Bilinear between the four nodes round the reference; beyond the lattice, that of its edge."""
        last = jnp.array(self.actions.shape[:2]) - 1
        # A box for a single reference has no width, and all its nodes are the same.
        width = jnp.where(self.high > self.low, self.high - self.low, 1)
        place = jnp.clip((reference - self.low) / width, 0, 1) * last
        corner = jnp.minimum(place.astype(jnp.int32), last - 1)
        x, y = place - corner
        near = jax.lax.dynamic_slice(self.actions, (corner[0], corner[1], 0, 0), (2, 2, *self.actions.shape[2:]))
        weight = jnp.outer(jnp.stack([1 - x, x]), jnp.stack([1 - y, y]))
        return jnp.einsum("xy,xyad->ad", weight, near)

    def references(self) -> Float[np.ndarray, "x y 2"]:
        """Of the nodes [N]."""
        axes = [np.linspace(float(self.low[i]), float(self.high[i]), self.actions.shape[i]) for i in range(2)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)


class Found(NamedTuple):
    """A table and what its nodes make in the plant, in the steady state."""

    table: GaitTable
    force: Float[np.ndarray, "x y 2"]
    """Mean over a window [N]."""
    smoothness: Float[np.ndarray, "x y 2"]
    """Sobolev term in the form `mean` [N]."""

    def missed(self) -> Float[np.ndarray, "x y"]:
        """How far each node's force is from its reference [N]."""
        distance: Float[np.ndarray, "x y"] = np.linalg.norm(self.force - self.table.references(), axis=-1)
        return distance


def find_gaits(
    plant: Plant,
    seen: Survey,
    lattice: Lattice,
    config: GaitConfig,
    report: Callable[[float, str], None] | None = None,
) -> Found:
    """A gait for every node of the lattice; a node beyond what the fin can do gets the nearest force that it can make.

    `seen` is the survey of the same plant, whose gaits the search begins with.
    """
    plant, table = jit_argument(plant), lattice.table()
    wanted = [seen.reachable.nearest((x, y)) for x, y in table.references().reshape(-1, 2).tolist()]
    target = jnp.asarray(wanted, jnp.float32)
    nodes = response(plant, _start(seen, target, lattice.nodes), config.cycles, _key())
    scale: AnyArray = np.ones(len(wanted), np.float32)
    for step in range(config.steps):
        exact = step >= config.steps - EXACT
        if step % 4 == 3 and not exact:
            nodes, scale = _helped(nodes, target, scale, lattice.nodes)
        moved = _moved(nodes, target, scale, lattice.nodes, config, exact)
        trial = response(plant, moved, config.cycles, _key())
        nodes, scale = _kept(nodes, trial, target, scale, 0.0 if exact else config.smoothness)
        if report is not None:
            missed = np.linalg.norm(np.asarray(nodes.out)[:, :2] - wanted, axis=1)
            report((step + 1) / config.steps, f"error {np.median(missed):.3f} N median, {missed.max():.2f} N greatest")
    shaped = (*lattice.nodes, -1)
    actions = jnp.asarray(np.tanh(nodes.raw)).reshape(*lattice.nodes, CYCLE_ACTIONS, 2)
    return Found(table._replace(actions=actions), np.asarray(nodes.out[:, :2]).reshape(shaped),
                 np.asarray(nodes.smoothness).reshape(shaped))  # fmt: skip


def _key() -> PRNGKeyArray:
    """Not a constant: making it starts JAX, which an import must not."""
    return key_of(0, "gaits")


def _start(seen: Survey, target: Float[AnyArray, "nodes 2"], shape: tuple[int, int]) -> Float[AnyArray, "nodes 12"]:
    """Of one wave, the gaits that come near and are like those of their neighbours; and the wave that comes nearest."""
    best: tuple[float, Float[np.ndarray, "nodes 12"]] | None = None
    wanted = np.asarray(target)
    for wave in dict.fromkeys(family.wave for family in seen.families):
        chosen = [i for i, family in enumerate(seen.families) if family.wave == wave]
        force = np.concatenate([seen.force[i] for i in chosen])
        gaits = np.concatenate([seen.families[i].gaits for i in chosen])
        raw = raw_of(gaits)
        apart = np.linalg.norm(force[None] - wanted[:, None], axis=-1)
        nearest = np.argmin(apart, axis=1)
        for _ in range(SWEEPS):
            middle = np.asarray(_neighbours(jnp.asarray(raw[nearest]), shape))
            unlike = np.sqrt(np.mean((raw[None] - middle[:, None]) ** 2, axis=-1))
            nearest = np.argmin(apart + UNLIKE_N * unlike, axis=1)
        cost = float(np.mean(apart[np.arange(len(wanted)), nearest]))
        if best is None or cost < best[0]:
            best = cost, raw[nearest]
    assert best is not None
    return jnp.asarray(best[1], jnp.float32)


SWEEPS = 10
UNLIKE_N = 0.5
"""What a difference of 1 (rms, in the atanh of the actions) from the neighbours costs at the start [N]."""


@eqx.filter_jit
def _moved(
    nodes: Response,
    target: Float[AnyArray, "nodes 2"],
    scale: Float[AnyArray, "nodes"],
    shape: tuple[int, int],
    config: GaitConfig,
    exact: bool,
) -> Float[AnyArray, "nodes 12"]:
    """One step of every node."""
    across = nodes.slope[:, :2]
    gram = across @ jnp.swapaxes(across, 1, 2)
    gram += (1e-3 * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-3) * jnp.eye(2)

    def along(force: Float[AnyArray, "nodes 2"]) -> Float[AnyArray, "nodes 12"]:
        """The least change that changes the force so."""
        return jnp.einsum("nij,ni->nj", across, jnp.linalg.solve(gram, force[..., None])[..., 0])

    wanted = _shortened(along(target - nodes.out[:, :2]), FORCE_STEP)
    if not exact:
        slope = config.smoothness * nodes.slope[:, 2]
        slope += config.likeness * (nodes.raw - _neighbours(nodes.raw, shape))
        free = slope - along(jnp.einsum("nij,nj->ni", across, slope))
        wanted -= _shortened(free, FREE_STEP)
    return nodes.raw + scale[:, None] * wanted


@eqx.filter_jit
def _kept(
    nodes: Response,
    trial: Response,
    target: Float[AnyArray, "nodes 2"],
    scale: Float[AnyArray, "nodes"],
    smoothness: float,
) -> tuple[Response, Float[AnyArray, "nodes"]]:
    """Each node where it is better off, with its next step longer after a gain and shorter after none."""

    def merit(nodes: Response) -> Float[AnyArray, "nodes"]:
        missed = jnp.linalg.norm(nodes.out[:, :2] - target, axis=1)
        return jnp.maximum(missed, ENOUGH_N if smoothness else 0) + smoothness * nodes.out[:, 2]

    # Leaning towards a neighbour may cost a little.
    better = merit(trial) < merit(nodes) + (ENOUGH_N if smoothness else 0)
    chosen = jax.tree.map(lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), trial, nodes)
    return chosen, jnp.where(better, jnp.minimum(1, 2 * scale), 0.4 * scale)


ENOUGH_N = 0.02
"""Before the last steps, errors below this do not matter."""


def _helped(
    nodes: Response, target: Float[AnyArray, "nodes 2"], scale: Float[AnyArray, "nodes"], shape: tuple[int, int]
) -> tuple[Response, Float[AnyArray, "nodes"]]:
    """Nodes that are stuck begin again where the best of their neighbours is."""
    missed = np.linalg.norm(np.asarray(nodes.out)[:, :2] - np.asarray(target), axis=1).reshape(shape)
    source = np.arange(missed.size).reshape(shape)
    for x, y in zip(*np.nonzero(missed > MISSED_N), strict=True):
        beside = [(x + i, y + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        beside = [(i, j) for i, j in beside if 0 <= i < shape[0] and 0 <= j < shape[1]]
        best = min(beside, key=lambda place: missed[place])
        if missed[best] < MISSED_N:
            source[x, y] = best[0] * shape[1] + best[1]
    moved = source.reshape(-1) != np.arange(missed.size)
    helped: Response = jax.tree.map(lambda leaf: np.asarray(leaf)[source.reshape(-1)], nodes)
    return helped, np.where(moved, np.float32(1.0), scale)


@partial(jax.jit, static_argnums=1)
def _neighbours(raw: Float[AnyArray, "nodes 12"], shape: tuple[int, int]) -> Float[AnyArray, "nodes 12"]:
    """Mean of the four neighbours; at the edge a node stands in for the one that is missing."""
    grid = jnp.pad(raw.reshape(*shape, -1), ((1, 1), (1, 1), (0, 0)), mode="edge")
    mean = (grid[2:, 1:-1] + grid[:-2, 1:-1] + grid[1:-1, 2:] + grid[1:-1, :-2]) / 4
    return mean.reshape(raw.shape)


def _shortened(step: Float[AnyArray, "nodes 12"], longest: float) -> Float[AnyArray, "nodes 12"]:
    length = jnp.linalg.norm(step, axis=1, keepdims=True)
    return step * jnp.minimum(1, longest / (length + 1e-9))
