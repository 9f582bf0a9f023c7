"""The search for gaits: those of a whole lattice of reference forces at once, in one compiled program.

Mean force and Sobolev term of a gait are smooth functions of its twelve numbers, and the plant gives their derivatives.
Two of the twelve directions change the force; Gauss-Newton steps along these bring it to the reference, while the other
ten lower the Sobolev term and keep each gait near those of its neighbours, so that gaits in between may be blended
(null-space projection, as for redundant manipulators: Siciliano and Khatib, Handbook of Robotics, Sec. 10.3).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.configuration import Configuration
from softfin.core.plant import Plant
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AnyArray
from softfin.core.randomness import key_of
from softfin.gaits.gait import GaitSearchResult, GaitTable
from softfin.gaits.simulate import CYCLES, GaitSensitivity, PreTanh, Report, Survey, gait_sensitivity, pre_tanh_of

Forces = Float[AnyArray, "nodes 2"]
Scales = Float[AnyArray, "nodes"]
Shape = tuple[int, int]


class GaitConfig(Configuration):
    """Configuration of the search for gaits."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Windows that a gait is repeated for from rest; the last one counts. The fin and its wake must settle before."""
    steps: PositiveInt = 24
    """Gauss-Newton steps; the last `EXACT` of them look at the force alone."""
    smoothness: NonNegativeFloat = 0.05
    """Weight of the Sobolev term (form `mean`) among what the force leaves open."""
    likeness: NonNegativeFloat = 0.6
    """Weight of the distance to the mean of the neighbours, squared."""


EXACT = 5
"""Last steps, without any but the force to please."""

STUCK_N = 0.05
"""A node further from its force than this begins again where a neighbour is."""

FORCE_STEP, FREE_STEP = 0.6, 0.25
"""Longest steps in the atanh of the actions, along the force and across."""

SWEEPS, UNLIKE_N = 10, 0.5
"""Rounds of choosing the gaits of the start, and the cost of a difference of 1 (rms, in the atanh of the actions) from
the neighbours [N]."""

ENOUGH_N = 0.02
"""Force error that does not matter before the last steps [N]."""


def find_gaits(
    plant: Plant, survey: Survey, table: GaitTable, config: GaitConfig, report: Report = lambda *_: None
) -> GaitSearchResult:
    """Find a gait for every node of an empty table, beginning with the gaits of a survey of the same plant.

    A node beyond the fin's reach gets the nearest force that the fin can make.
    """
    # The key is no constant of the module: making it starts JAX, which an import must not.
    plant, key, shape = jit_argument(plant), key_of(0, "gaits"), table.nodes
    wanted = survey.reachable.nearest(table.references().reshape(-1, 2))
    target = jnp.asarray(wanted, jnp.float32)
    nodes = gait_sensitivity(plant, _start(survey, target, shape), config.cycles, key)
    scale: AnyArray = np.ones(len(wanted), np.float32)
    for step in range(config.steps):
        exact = step >= config.steps - EXACT
        if step % 4 == 3 and not exact:
            nodes, scale = _restarted(nodes, target, scale, shape)
        moved = _stepped(nodes, target, scale, shape, config, exact)
        trial = gait_sensitivity(plant, moved, config.cycles, key)
        nodes, scale = _better(nodes, trial, target, scale, 0.0 if exact else config.smoothness)
        error = np.linalg.norm(np.asarray(nodes.out)[:, :2] - wanted, axis=1)
        report((step + 1) / config.steps, f"error {np.median(error):.3f} N median, {error.max():.2f} N greatest")
    actions = np.tanh(nodes.pre_tanh).reshape(*shape, CYCLE_ACTIONS, 2)
    force, smoothness = (np.asarray(each).reshape(*shape, 2) for each in (nodes.out[:, :2], nodes.smoothness))
    return GaitSearchResult(table._replace(actions=actions), force, smoothness)


def _start(survey: Survey, target: Forces, shape: Shape) -> PreTanh:
    """Choose the waveform that comes nearest; of it, gaits that come near and are like those of their neighbours."""
    starts = []
    for gaits, force in zip(survey.gaits, survey.force, strict=True):
        pre_tanh = pre_tanh_of(gaits)
        apart = np.linalg.norm(force[None] - np.asarray(target)[:, None], axis=-1)
        nearest = np.argmin(apart, axis=1)
        for _ in range(SWEEPS):
            middle = np.asarray(_neighbours(jnp.asarray(pre_tanh[nearest]), shape))
            unlike = np.sqrt(np.mean((pre_tanh[None] - middle[:, None]) ** 2, axis=-1))
            nearest = np.argmin(apart + UNLIKE_N * unlike, axis=1)
        starts.append((float(np.mean(apart[np.arange(len(apart)), nearest])), pre_tanh[nearest]))
    return jnp.asarray(min(starts, key=lambda start: start[0])[1], jnp.float32)


@eqx.filter_jit
def _stepped(
    nodes: GaitSensitivity, target: Forces, scale: Scales, shape: Shape, config: GaitConfig, exact: bool
) -> PreTanh:
    """Take one step of every node."""
    across = nodes.slope[:, :2]
    gram = across @ jnp.swapaxes(across, 1, 2)
    gram += (1e-3 * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-3) * jnp.eye(2)

    def along(force: Forces) -> PreTanh:
        """Return the smallest change of the actions that changes the force so."""
        return jnp.einsum("nij,ni->nj", across, jnp.linalg.solve(gram, force[..., None])[..., 0])

    wanted = _shortened(along(target - nodes.out[:, :2]), FORCE_STEP)
    if not exact:
        slope = config.smoothness * nodes.slope[:, 2]
        slope += config.likeness * (nodes.pre_tanh - _neighbours(nodes.pre_tanh, shape))
        free = slope - along(jnp.einsum("nij,nj->ni", across, slope))
        wanted -= _shortened(free, FREE_STEP)
    return nodes.pre_tanh + scale[:, None] * wanted


@eqx.filter_jit
def _better(
    nodes: GaitSensitivity, trial: GaitSensitivity, target: Forces, scale: Scales, smoothness: float
) -> tuple[GaitSensitivity, Scales]:
    """Keep the better one of each node and its trial; the next step is longer after a gain, shorter after none."""

    def merit(nodes: GaitSensitivity) -> Scales:
        error = jnp.linalg.norm(nodes.out[:, :2] - target, axis=1)
        return jnp.maximum(error, ENOUGH_N if smoothness else 0) + smoothness * nodes.out[:, 2]

    # Leaning towards a neighbour may cost a little.
    better = merit(trial) < merit(nodes) + (ENOUGH_N if smoothness else 0)
    chosen = jax.tree.map(lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), trial, nodes)
    return chosen, jnp.where(better, jnp.minimum(1, 2 * scale), 0.4 * scale)


def _restarted(nodes: GaitSensitivity, target: Forces, scale: Scales, shape: Shape) -> tuple[GaitSensitivity, Scales]:
    """Let nodes that are stuck begin again where the best of their neighbours is."""
    error = np.linalg.norm(np.asarray(nodes.out)[:, :2] - np.asarray(target), axis=1)
    padded = np.pad(error.reshape(shape), 1, constant_values=np.inf)
    beside = np.stack([padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]]).reshape(4, -1)
    moved = (error > STUCK_N) & (beside.min(axis=0) < STUCK_N)
    steps = np.array([shape[1], -shape[1], 1, -1])[beside.argmin(axis=0)]
    source = np.arange(error.size) + np.where(moved, steps, 0)
    helped: GaitSensitivity = jax.tree.map(lambda leaf: np.asarray(leaf)[source], nodes)
    return helped, np.where(moved, np.float32(1.0), scale)


@partial(jax.jit, static_argnums=1)
def _neighbours(pre_tanh: PreTanh, shape: Shape) -> PreTanh:
    """Average the four neighbours; at the edge a node stands in for the one that is missing."""
    grid = jnp.pad(pre_tanh.reshape(*shape, -1), ((1, 1), (1, 1), (0, 0)), mode="edge")
    mean = (grid[2:, 1:-1] + grid[:-2, 1:-1] + grid[1:-1, 2:] + grid[1:-1, :-2]) / 4
    return mean.reshape(pre_tanh.shape)


def _shortened(step: PreTanh, longest: float) -> PreTanh:
    length = jnp.linalg.norm(step, axis=1, keepdims=True)
    return step * jnp.minimum(1, longest / (length + 1e-9))
