"""Finds the family of a fin by simulation: samples fins around a tank, runs a controller on each of
them, and keeps the main components of the differences between the fins."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.control.controller import LoadedController
from softfin.control.family import MIN_FINS, Family
from softfin.control.gait import GaitStep
from softfin.control.pytrees import register_controllers
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.operations import NUMPY
from softfin.core.plant import mean_loads
from softfin.core.progress import Progress, silent
from softfin.core.quantities import AnyArray
from softfin.core.randomness import named_key
from softfin.evaluation.experiment import simulate
from softfin.gaits.reachable import Reachable, cell_corners
from softfin.tank.randomization import DomainRandomization, sample_tank
from softfin.tank.tank import Tank

STEADY_WINDOWS = 3
"""Number of windows to run from rest; the last one is tabulated."""

OUTSIDE_WEIGHT = 0.3
"""Weight of nodes outside the reach or the cell of the gaits in the components, relative to
other nodes. They are moved to the edge."""

BATCH = 128
"""Number of references that are simulated in parallel."""

TINY = 1e-9
"""Change of a feature below which no fin changes it."""

HELD_OUT = 4
"""One in this many fins is held out, to measure the error that the components leave."""


class FamilyConfig(Configuration):
    """Configuration of a family."""

    fins: int = Field(default=64, ge=MIN_FINS, le=2000)
    """Number of sampled fins."""
    coefficients: int = Field(default=6, ge=1, le=12)
    """Number of coefficients."""
    nodes: int = Field(default=9, ge=3, le=33)
    """Number of lattice nodes per axis at which all fins are simulated."""
    nominal_nodes: int = Field(default=33, ge=3, le=129)
    """Number of lattice nodes per axis at which the nominal fin is simulated."""
    seed: int = Field(default=0, ge=0)
    """Seed of the sampled fins."""
    widths: DomainRandomization = DomainRandomization(
        temperature_c=5.0,
        stiffness=0.3,
        drag=0.3,
        added_mass=0.15,
        lag=0.3,
        dead_time=0.3,
        drift=0.0,
        misalignment_rad=0.03,
    )
    """Half-widths of the parameter distributions, which are centred on the values of the tank."""


class _Steady(NamedTuple):
    """Last window of a controller on one fin, at each reference."""

    force: Float[AnyArray, "*references 2"]
    """True mean force over the window [N]."""
    features: Float[AnyArray, "*references actions features"]
    friction: Float[AnyArray, "*references actions 2"]


def find_family(
    controller: LoadedController,
    tank: Tank,
    config: FamilyConfig | None = None,
    progress: Progress = silent,
) -> Family:
    """Find the family of fins around a tank for a controller.

    Raises ConfigurationError if the controller is a policy or does not contain the reach of its
    fin.
    """
    config = config or FamilyConfig()
    if controller.kind != GaitStep.kind:
        raise ConfigurationError(
            f"{controller.artifact.name}: the motion of a policy does not repeat in every window, "
            "so its pattern does not show how the fin has changed; use gaits (softfin map), or "
            "--feedback without a family"
        )
    reachable = controller.reachable
    if reachable is None:
        raise ConfigurationError(
            f"{controller.artifact.name}: the reach of the fin is unknown; use gaits (softfin map)"
        )
    if not any(config.widths.model_dump().values()):
        raise ConfigurationError("widths: all are 0, so all fins are the same; set some of them")
    register_controllers()
    box = reachable.bounding_box()

    def lattice(nodes: int) -> Float[np.ndarray, "nodes 2"]:
        axes = np.linspace(box.low, box.high, nodes)
        return np.stack(np.meshgrid(*axes.T, indexing="ij"), axis=-1).reshape(-1, 2)

    def trackable(references: Float[np.ndarray, "nodes 2"]) -> Float[np.ndarray, "nodes 2"]:
        """Move references into the reach and the cell of the gaits."""
        inside = np.clip(reachable.project(references), *cell_corners(controller.cells))
        return np.asarray(inside, np.float32)

    def run(fin: Tank, references: Float[np.ndarray, "references 2"]) -> _Steady:
        found: _Steady = _run_references(controller, fin, jnp.asarray(trackable(references)))
        return _Steady(*map(np.asarray, found))

    fine = run(tank, lattice(config.nominal_nodes))
    coarse = lattice(config.nodes)
    between = trackable(_references_between(coarse, reachable))
    nominal = [run(tank, coarse), run(tank, between)]
    fitted: list[list[_Steady]] = []
    held_out: list[list[_Steady]] = []
    for index in range(config.fins):
        fin = sample_tank(tank, named_key(config.seed, f"family/{index}"), config.widths)
        places = [coarse, between] if index % HELD_OUT == 0 else [coarse]
        changes = [
            jax.tree.map(np.subtract, run(fin, at), before)
            for at, before in zip(places, nominal, strict=False)
        ]
        (fitted if len(places) == 1 else held_out).append(changes)
        progress("family", (index + 1) / config.fins, f"fin {index + 1} of {config.fins}")
    moved = np.linalg.norm(trackable(coarse) - coarse, axis=1)
    weights = np.where(moved > 0.1 * reachable.reach_n, OUTSIDE_WEIGHT, 1.0)
    components = _components([changes[0] for changes in fitted], weights, config.coefficients)
    shape = (config.nominal_nodes, config.nominal_nodes)
    features = np.reshape(fine.features, (*shape, *fine.features.shape[1:]))
    coarse_shape = (config.nodes, config.nodes)
    family = Family(
        low=np.asarray(box.low, np.float32),
        high=np.asarray(box.high, np.float32),
        nominal=features,
        nominal_noise=_roughness(features),
        friction=fine.friction.reshape(*shape, -1, 2),
        force=np.moveaxis(components.force, 0, 1).reshape(*coarse_shape, -1, 2),
        features=np.moveaxis(components.features, 0, 2).reshape(
            *coarse_shape, *features.shape[2:-1], -1, features.shape[-1]
        ),
        force_noise=np.zeros(2),
        feature_noise=np.zeros(features.shape[-1]),
        feature_spread=features.std(axis=(0, 1, 2)),
    )
    force_noise, feature_noise = _unexplained(family, components, held_out, between)
    family = family._replace(force_noise=force_noise, feature_noise=feature_noise)
    return Family(*(np.asarray(part, np.float32) for part in family))


def _references_between(
    nodes: Float[np.ndarray, "nodes 2"], reachable: Reachable
) -> Float[np.ndarray, "nodes 2"]:
    """Return references spread evenly over the reach, as many as nodes but not at the nodes."""
    radius = np.sqrt((np.arange(len(nodes)) + 0.5) / len(nodes))
    # The golden angle spreads the references evenly.
    angle = 2.399963 * np.arange(len(nodes))
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    far = reachable.centre + 10 * float(np.max(reachable.radius)) * ways
    edge = reachable.project(far) - reachable.centre
    return np.asarray(reachable.centre + radius[:, None] * edge)


def _roughness(table: Float[np.ndarray, "x y actions features"]) -> np.ndarray:
    """Estimate the error of linear interpolation between the nodes ``(x, y, features)``: half of
    the RMS second difference along both axes."""
    bends = []
    for axis in (0, 1):
        padded = np.pad(table, [(1, 1) if axis == each else (0, 0) for each in range(4)], "edge")
        bends.append(np.diff(padded, 2, axis=axis))
    return np.asarray(0.5 * np.sqrt((bends[0] ** 2 + bends[1] ** 2).mean(axis=2)))


class _Components(NamedTuple):
    force: Float[np.ndarray, "coefficients references 2"]
    features: Float[np.ndarray, "coefficients references actions features"]
    project: Callable[[_Steady], Float[np.ndarray, "coefficients"]]
    """Function that returns the coefficients of a fin from its changes at the nodes."""


def _components(
    changes: Sequence[_Steady], weights: Float[np.ndarray, "references"], count: int
) -> _Components:
    """Return the changes in force and features for coefficients of variance 1.

    The mean force has the same weight as all features together, and each feature has an equal part.
    """
    forces = np.stack([change.force for change in changes])
    features = np.stack([change.features for change in changes])
    force_scale = weights[:, None] / np.maximum(np.sqrt((forces**2).mean() * 2), TINY)
    each = np.sqrt((features**2).mean(axis=(0, 1, 2)) * features[0, 0].size)
    feature_scale = weights[:, None, None] / np.maximum(each, TINY)

    def flat(change: _Steady) -> Float[np.ndarray, "values"]:
        scaled = [force_scale * change.force, feature_scale * change.features]
        return np.concatenate([part.ravel() for part in scaled])

    every = np.stack(list(map(flat, changes)))
    _, lengths, directions = np.linalg.svd(every, full_matrices=False)
    projection = directions[:count].T / np.maximum(lengths[:count], TINY) * np.sqrt(len(changes))
    fitted = every @ projection
    solved = [
        np.linalg.lstsq(fitted, values.reshape(len(fitted), -1), rcond=None)[0]
        for values in (forces, features)
    ]
    return _Components(
        solved[0].reshape(count, *forces.shape[1:]),
        solved[1].reshape(count, *features.shape[1:]),
        lambda change: np.asarray(flat(change) @ projection),
    )


def _unexplained(
    family: Family,
    components: _Components,
    held_out: Sequence[Sequence[_Steady]],
    between: Float[np.ndarray, "references 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "features"]]:
    """Return the standard deviations of the mean force and of the features of held-out fins, after
    subtraction of the part that the tables explain, at references between the nodes."""
    force, features = family.interpolate(NUMPY, between, family.force, family.features)
    left = []
    for at_nodes, at_others in held_out:
        coefficients = components.project(at_nodes)
        left.append(
            _Steady(
                at_others.force - np.einsum("c,rcf->rf", coefficients, force),
                at_others.features - np.einsum("c,racf->raf", coefficients, features),
                at_others.friction,
            )
        )
    # Omit the largest 5%: at a few references, the gaits differ so much from their neighbours that
    # these errors would dominate all others.
    forces = np.abs([each.force for each in left]).reshape(-1, 2)
    others = np.abs([each.features for each in left]).reshape(-1, features.shape[-1])
    return tuple(
        np.sqrt((np.sort(values, axis=0)[: int(0.95 * len(values))] ** 2).mean(axis=0))
        for values in (forces, others)
    )


@eqx.filter_jit
def _run_references(
    controller: LoadedController, tank: Tank, references: Float[Array, "references 2"]
) -> _Steady:
    clock = controller.clock
    durations = clock.action_ticks(STEADY_WINDOWS * clock.window_actions)
    # Remove only the random errors of the sensor: misalignment and filter are part of the fin.
    sensor = tank.sensor
    errors = (sensor.noise, sensor.drift, sensor.resolution)
    exact = eqx.tree_at(
        lambda tank: (tank.sensor.noise, tank.sensor.drift, tank.sensor.resolution),
        tank,
        jax.tree.map(jnp.zeros_like, errors),
    )

    ends = np.cumsum(durations)
    last = range(len(durations) - clock.window_actions, len(durations))

    def one(reference: Float[Array, "2"]) -> _Steady:
        references = jnp.broadcast_to(reference, (len(durations), 2))
        run = simulate(controller, exact, references, jax.random.key(0))
        features = []
        friction = []
        for action in last:
            ticks = slice(ends[action] - durations[action], ends[action])
            velocity = jnp.asarray(run.reading.velocity[ticks])
            loads = mean_loads(run.output.torque[ticks], velocity, durations[action])
            force = run.reading.force[ticks].mean(axis=0)
            angle = run.reading.angle[ends[action] - 1]
            features.append(jnp.concatenate([force, angle[None], *loads]))
            friction.append(jnp.stack([jnp.sign(velocity).mean(), jnp.abs(velocity).mean()]))
        force = run.output.true_force[-clock.window_ticks :].mean(axis=0)
        return _Steady(force, jnp.stack(features), jnp.stack(friction))

    found: _Steady = jax.lax.map(one, references, batch_size=BATCH)
    return found
