"""Finds gaits for all nodes of a lattice of reference forces in one compiled program.

The mean force and the Sobolev term of a gait are smooth functions of twelve numbers, and the plant
provides their derivatives. Two of the twelve directions change the force: Gauss-Newton steps along
them move the force to the reference. Steps along the other ten directions reduce the Sobolev term
and keep neighbouring gaits similar, so that gaits can be interpolated. This is the null-space
projection of redundant manipulators (Siciliano and Khatib, Handbook of Robotics, Sec. 10.3).

All gaits start from one family of strokes, so that neighbours are similar. Finally, the spacing is
halved: new nodes start from interpolated gaits and take the shortest steps to their references,
which removes the interpolation error.
"""

from collections.abc import Callable
from functools import partial
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from scipy.interpolate import RegularGridInterpolator

from softfin.core.configuration import Configuration
from softfin.core.operations import jax_operations
from softfin.core.plant import Plant, has_torque
from softfin.core.quantities import AnyArray
from softfin.core.randomness import named_key
from softfin.gaits.gait import GaitSearchResult, GaitTable
from softfin.gaits.simulate import (
    AMPLITUDES,
    CENTRES,
    CYCLES,
    GaitSensitivity,
    PreTanh,
    ReportSearch,
    Survey,
    SurveyConfig,
    action_to_pre_tanh,
    gait_families,
    gait_sensitivity,
    simulate_gait,
    simulate_gait_with_power,
    simulate_gaits,
    strokes,
)

NodeForces = Float[AnyArray, "nodes 2"]
StepScales = Float[AnyArray, "nodes"]
LatticeShape = tuple[int, int]
ReportNodes = Callable[[GaitSensitivity, NodeForces], None]


class GaitConfig(Configuration):
    """Configuration of the search for gaits."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Number of windows for which a gait is repeated from rest; more if windows are shorter than 2
    s. Only the last window is evaluated, when the fin and its wake are in a steady state."""
    steps: PositiveInt = 8
    """Number of Gauss-Newton steps; the last `EXACT` steps reduce only the force error."""
    smoothness: NonNegativeFloat = 0.05
    """Weight of the Sobolev term (form `mean`) in the directions that do not change the force."""
    power: NonNegativeFloat = 0.0
    """Weight of the mean power that the drive delivers to the fin, in the same directions [N/W]."""
    likeness: NonNegativeFloat = 1.0
    """Weight of the squared distance from the mean of the neighbours."""
    halvings: NonNegativeInt = 1
    """Number of times the lattice spacing is halved after these steps."""


EXACT = 2
"""Number of final steps that reduce only the force error, and of steps for nodes added by
halving."""

STUCK_N = 0.05
"""Force error above which a node restarts from a neighbour, for the paper's fin [N].

The search divides all forces by the size of the fin (`Reachable.size`), so constants in newtons
apply to the paper's fin.
"""

FORCE_STEP = 0.6
"""Maximum step in the directions that change the force, in the atanh of the actions."""

FREE_STEP = 0.25
"""Maximum step in the other directions, in the atanh of the actions."""

SWEEPS = 10
"""Number of rounds in which the initial gaits are chosen."""

UNLIKE_N = 0.5
"""Cost of an initial gait per unit of RMS difference from its neighbours in the atanh of the
actions [N]."""

LARGE_N = 0.1
"""Cost of the largest amplitude in the first round [N]. Some forces can be produced with both small
and large strokes; small strokes are preferred."""

FORCE_PER_POWER = 5.0
"""Upper bound of the power per additional newton [W/N], so that a force error costs more than the
power that it saves."""

START_POWER = 0.3
"""Maximum weight of the power of an initial gait [N/W]; with a larger weight, initial gaits would
produce too little force."""

FINER = 5
"""Number of strokes per step between the surveyed centres and amplitudes; their forces are
interpolated."""

ENOUGH_N = 0.02
"""Force error below which the error is not reduced before the final steps [N]."""


def find_gaits(
    plant: Plant,
    survey: Survey,
    table: GaitTable,
    config: GaitConfig,
    report: ReportSearch = lambda *_: None,
) -> GaitSearchResult:
    """Find a gait for each node of an empty table, starting from a survey of the same plant.

    The spacing of the returned table is halved `config.halvings` times. A node outside the
    reachable region gets the gait of the nearest reachable force.
    """
    total = config.steps + EXACT * config.halvings
    done = 0
    size = survey.reachable.size

    def told(nodes: GaitSensitivity, target: NodeForces) -> None:
        nonlocal done
        done += 1
        error = _force_errors(nodes, target) * size
        report(done / total, f"error {np.median(error):.2g} N median, {error.max():.2g} N maximum")

    nodes = _search(plant, survey, table, config, told)
    for _ in range(config.halvings):
        nodes, table = _between(plant, survey, nodes, _filled(table, nodes), config, told)
    shape = (*table.nodes, 2)
    force = np.asarray(nodes.out[:, :2] * size, np.float32).reshape(shape)
    smoothness = np.asarray(nodes.smoothness * size, np.float32).reshape(shape)
    found = _filled(table, nodes)
    power = None
    if has_torque(plant):
        gaits = np.asarray(found.actions).reshape(-1, *found.actions.shape[2:])
        cycles = SurveyConfig(cycles=config.cycles)
        _, power = simulate_gaits(plant, gaits, cycles, survey.clock, simulate_gait_with_power)
        assert power is not None
        power = power.reshape(table.nodes)
    return GaitSearchResult(found, force, smoothness, power)


def _simulate(
    plant: Plant, survey: Survey, pre_tanh: PreTanh, config: GaitConfig
) -> GaitSensitivity:
    """Simulate gaits; forces and force gradients are divided by the fin size."""
    # The key is not a module constant: creating it starts JAX, which an import must not do.
    key = named_key(0, "gaits")
    simulate = simulate_gait_with_power if config.power else simulate_gait
    nodes = gait_sensitivity(plant, pre_tanh, config.cycles, key, survey.clock, simulate)
    size = np.float32(survey.reachable.size)
    return nodes._replace(
        out=nodes.out / size, slope=nodes.slope / size, smoothness=nodes.smoothness / size
    )


def _targets(survey: Survey, references: NodeForces) -> NodeForces:
    """Return the nearest reachable force for each reference [N], divided by the fin size."""
    reachable = survey.reachable
    return jnp.asarray(reachable.nearest(references) / reachable.size, jnp.float32)


def _force_errors(nodes: GaitSensitivity, target: NodeForces) -> Float[np.ndarray, "nodes"]:
    return np.asarray(np.linalg.norm(np.asarray(nodes.out)[:, :2] - np.asarray(target), axis=1))


def _filled(table: GaitTable, nodes: GaitSensitivity) -> GaitTable:
    return table._replace(actions=np.tanh(np.asarray(nodes.pre_tanh)).reshape(*table.nodes, -1, 2))


def _search(
    plant: Plant,
    survey: Survey,
    table: GaitTable,
    config: GaitConfig,
    told: ReportNodes,
) -> GaitSensitivity:
    """Find gaits for the nodes of a table, starting from the strokes of the survey."""
    shape = table.nodes
    target = _targets(survey, table.references().reshape(-1, 2))
    nodes = _simulate(plant, survey, _start(survey, target, shape, config.power), config)
    scale: AnyArray = np.ones(len(target), np.float32)
    for step in range(config.steps):
        exact = step >= config.steps - EXACT
        # Restart only every fourth step so that nodes can improve in between.
        if step % 4 == 3 and not exact:
            nodes, scale = _restarted(nodes, target, scale, shape)
        moved = _stepped(nodes, target, scale, shape, config, exact)
        trial = _simulate(plant, survey, moved, config)
        nodes, scale = _better(nodes, trial, target, scale, config, exact)
        told(nodes, target)
    return nodes


def _between(
    plant: Plant,
    survey: Survey,
    nodes: GaitSensitivity,
    table: GaitTable,
    config: GaitConfig,
    told: ReportNodes,
) -> tuple[GaitSensitivity, GaitTable]:
    """Add nodes halfway between the nodes of a table, starting from interpolated gaits."""
    finer = table.halved()
    # Every second node in each direction is a node of the old table.
    new = np.ones(finer.nodes, bool)
    new[::2, ::2] = False
    references = finer.references()[new]
    target = _targets(survey, references)
    blends = np.stack([table.gait(reference) for reference in references])
    added = _simulate(plant, survey, action_to_pre_tanh(blends), config)
    scale: AnyArray = np.ones(len(target), np.float32)
    for _ in range(EXACT):
        moved = _stepped(added, target, scale, (len(target), 1), config, True)
        trial = _simulate(plant, survey, moved, config)
        added, scale = _better(added, trial, target, scale, config, True)
        told(added, target)

    def placed(old: AnyArray, added: AnyArray) -> AnyArray:
        every = np.empty((new.size, *old.shape[1:]), np.float32)
        every[new.reshape(-1)] = added
        every[~new.reshape(-1)] = old
        return every

    every: GaitSensitivity = jax.tree.map(placed, nodes, added)
    return every, finer


def _start(survey: Survey, target: NodeForces, shape: LatticeShape, power: float) -> PreTanh:
    """Choose the initial gaits: strokes of one family, close to the target forces and similar to
    their neighbours.

    A family is a waveform at a velocity, with different centres and amplitudes. The family with the
    lowest mean distance from the target forces is used, or, if the survey contains the power, the
    waveform with the lowest mean of distance and power.
    """
    starts = []
    finer = (_finer(CENTRES), _finer(AMPLITUDES))
    places = np.array(list(product(*finer)))
    families = gait_families(survey.clock, survey.velocities)
    size = survey.reachable.size
    surveyed = survey.force / size
    if survey.power is not None:
        surveyed = np.concatenate([surveyed, survey.power[..., None] / size], axis=-1)
    gaits = []
    responses = []
    for family, response in zip(families, surveyed, strict=True):
        by_stroke = RegularGridInterpolator((CENTRES, AMPLITUDES), response, method="cubic")
        responses.append(by_stroke(places))
        gaits.append(action_to_pre_tanh(strokes(*family, *places.T)))
    # Velocities have very different powers, so that the strokes of all of them are compared.
    together = 1 if survey.power is None else len(survey.velocities)
    for first in range(0, len(families), together):
        pre_tanh = np.concatenate(gaits[first : first + together])
        response = np.concatenate(responses[first : first + together])
        # Distance between the force of each stroke and each target, (nodes, strokes).
        apart = np.linalg.norm(response[None, :, :2] - np.asarray(target)[:, None], axis=-1)
        if survey.power is not None:
            apart += min(power, START_POWER) * response[:, 2]
        large = np.tile(LARGE_N * places[:, 1] / AMPLITUDES[-1], together)
        nearest = np.argmin(apart + large, axis=1)
        for _ in range(SWEEPS):
            middle = np.asarray(_neighbours(jnp.asarray(pre_tanh[nearest]), shape))
            unlike = np.sqrt(np.mean((pre_tanh[None] - middle[:, None]) ** 2, axis=-1))
            nearest = np.argmin(apart + UNLIKE_N * unlike, axis=1)
        cost = float(np.mean(apart[np.arange(len(apart)), nearest]))
        starts.append((cost, pre_tanh[nearest]))
    return jnp.asarray(min(starts, key=lambda start: start[0])[1], jnp.float32)


def _finer(values: np.ndarray) -> np.ndarray:
    return np.linspace(values[0], values[-1], FINER * (len(values) - 1) + 1)


@eqx.filter_jit
def _stepped(
    nodes: GaitSensitivity,
    target: NodeForces,
    scale: StepScales,
    shape: LatticeShape,
    config: GaitConfig,
    exact: bool,
) -> PreTanh:
    """Take one step at every node."""
    # With the Jacobian J of the force, the smallest step that changes the force by d is
    # J^T (J J^T)^-1 d. The small diagonal term keeps it finite if a gait does not change the
    # force.
    across = nodes.slope[:, :2]
    gram = across @ jnp.swapaxes(across, 1, 2)
    gram += (1e-3 * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-3) * jnp.eye(2)

    def along(force: NodeForces) -> PreTanh:
        """Return the smallest step that changes the force by the given amount."""
        share, _ = jax.vmap(jax_operations().solve)(gram, force[..., None])
        return jnp.einsum("nij,ni->nj", across, share[..., 0])

    wanted = _shortened(along(target - nodes.out[:, :2]), FORCE_STEP)
    if not exact:
        slope = _cost(nodes.slope, config)
        slope += config.likeness * (nodes.pre_tanh - _neighbours(nodes.pre_tanh, shape))
        # The projection on the null space of J: (1 - J^T (J J^T)^-1 J) slope.
        free = slope - along(jnp.einsum("nij,nj->ni", across, slope))
        wanted -= _shortened(free, FREE_STEP)
    return nodes.pre_tanh + scale[:, None] * wanted


def _cost(
    outputs: Float[AnyArray, "nodes outputs *values"], config: GaitConfig
) -> Float[AnyArray, "nodes *values"]:
    """Return the weighted sum of the Sobolev term and the power, or of their gradients."""
    cost = config.smoothness * outputs[:, 2]
    return cost + config.power * outputs[:, 3] if config.power else cost


@eqx.filter_jit
def _better(
    nodes: GaitSensitivity,
    trial: GaitSensitivity,
    target: NodeForces,
    scale: StepScales,
    config: GaitConfig,
    exact: bool,
) -> tuple[GaitSensitivity, StepScales]:
    """For each node, keep the better of the current gait and the trial.

    The next step of a node is longer if the trial was better, otherwise shorter.
    """

    def merit(nodes: GaitSensitivity) -> StepScales:
        error: StepScales = jnp.linalg.norm(nodes.out[:, :2] - target, axis=1)
        if exact:
            return error
        if config.power:
            error *= 1 + FORCE_PER_POWER * config.power
        cost: StepScales = jnp.maximum(error, ENOUGH_N) + _cost(nodes.out, config)
        return cost

    # The tolerance allows steps towards the neighbours, which may increase the error slightly.
    better = merit(trial) < merit(nodes) + (0 if exact else ENOUGH_N)
    chosen = jax.tree.map(
        lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), trial, nodes
    )
    return chosen, jnp.where(better, jnp.minimum(1, 2 * scale), 0.4 * scale)


def _restarted(
    nodes: GaitSensitivity, target: NodeForces, scale: StepScales, shape: LatticeShape
) -> tuple[GaitSensitivity, StepScales]:
    """Replace each stuck node by its best neighbour unless this neighbour is also stuck."""
    error = _force_errors(nodes, target)
    padded = np.pad(error.reshape(shape), 1, constant_values=np.inf)
    beside = np.stack(
        [padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]]
    ).reshape(4, -1)
    moved = (error > STUCK_N) & (beside.min(axis=0) < STUCK_N)
    steps = np.array([shape[1], -shape[1], 1, -1])[beside.argmin(axis=0)]
    source = np.arange(error.size) + np.where(moved, steps, 0)
    helped: GaitSensitivity = jax.tree.map(lambda leaf: np.asarray(leaf)[source], nodes)
    return helped, np.where(moved, np.float32(1.0), scale)


@partial(jax.jit, static_argnums=1)
def _neighbours(pre_tanh: PreTanh, shape: LatticeShape) -> PreTanh:
    """Return the mean of the four neighbours of each node; at the edge, the node itself replaces a
    missing neighbour."""
    grid = jnp.pad(pre_tanh.reshape(*shape, -1), ((1, 1), (1, 1), (0, 0)), mode="edge")
    mean = (grid[2:, 1:-1] + grid[:-2, 1:-1] + grid[1:-1, 2:] + grid[1:-1, :-2]) / 4
    return mean.reshape(pre_tanh.shape)


def _shortened(step: PreTanh, longest: float) -> PreTanh:
    """Scale steps down to a maximum length."""
    length = jnp.linalg.norm(step, axis=1, keepdims=True)
    return step * jnp.minimum(1, longest / (length + 1e-9))
