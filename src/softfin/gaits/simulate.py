"""Simulates gaits in a plant (mean forces, Sobolev terms and their gradients), and surveys the
reachable forces of a plant.

The survey simulates a grid of gaits and then pushes the boundary of their forces outwards by
gradient ascent.
"""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.compilation import jit, map_in_threads
from softfin.core.configuration import Configuration
from softfin.core.plant import Plant, hold, hold_action_with_hidden
from softfin.core.power import mechanical_power
from softfin.core.quantities import AnyArray, Command, action_to_command
from softfin.core.randomness import named_key
from softfin.core.window import sobolev
from softfin.gaits.gait import Gait
from softfin.gaits.reachable import Reachable, directions

ReportSearch = Callable[[float, str], None]
"""Progress callback: completed fraction (0 to 1) and a note."""

PreTanh = Float[AnyArray, "gaits values"]
"""atanh of the actions of gaits [-]."""

CYCLES = 3
"""Default number of windows for which a gait is repeated from rest (see `steady_state_force`)."""

MAX_SEARCHED_ACTION = 0.97
"""Maximum magnitude of initial actions; steps are taken in their atanh, which is infinite at 1."""

SIDE_BY_SIDE = 32
"""Number of gaits per call of the program that computes gradients; fixed so that all callers share
the compiled program."""

STROKE_SHAPES = ((1, -1), (1, -1, -1), (1, 1, -1, -1), (1, 0.5, -0.5, -1, -0.5, 0.5))
"""Angle of each action of a stroke, relative to the centre and divided by the amplitude. The survey
uses the shapes that divide the window evenly: on the paper's clock, strokes of 0.67 s, 1 s and 2
s."""

VELOCITIES = (1.0, 0.3, -0.3)
"""Velocities of the surveyed gaits, as actions."""

POWER_VELOCITIES = (1.0, 0.6, 0.3, 0.0, -0.3, -0.6)
"""Velocities of the surveyed gaits if power is minimized, as actions; the power is lowest if a
stroke lasts as long as its action."""

CENTRES = np.linspace(-1, 1, 11)
"""Centre angles of the surveyed gaits, as actions."""

AMPLITUDES = np.linspace(0.05, 0.9, 7)
"""Amplitudes of the surveyed gaits, as actions."""

NEAR = 0.2
"""Maximum distance at which a force is treated as close to the middle of all forces, as a fraction
of half the diagonal of their bounding box."""

ASIDE = 2.0
"""Cost of a force across the search direction, relative to the gain of an equal force along the
direction."""


class GaitResponse(NamedTuple):
    """Steady-state forces of a gait."""

    force: Float[Array, "2"]
    """Mean force over the last window [N]."""
    smoothness: Float[Array, "2"]
    """Sobolev term of the last window in the form `mean` [N]."""
    power: Float[Array, ""] | None = None
    """Mean power delivered to the fin in the last window [W]; None if not computed."""


def gait_families(
    clock: ActionClock, velocities: Sequence[float] = VELOCITIES
) -> tuple[tuple[Float[np.ndarray, "actions"], float], ...]:
    """Return the waveform and velocity of each gait family. Similar gaits of one family produce
    similar forces."""
    count = clock.window_actions
    waveforms = [
        np.tile(np.array(stroke, float), count // len(stroke))
        for stroke in STROKE_SHAPES
        if count % len(stroke) == 0
    ]
    if not waveforms:
        # One stroke per window.
        waveforms = [np.cos(2 * np.pi * np.arange(count) / count)]
    if count % 2:
        # Strokes to both sides, and a pause.
        waveforms.append(np.append(np.resize((1.0, -1.0), count - 1), 0.0))
    return tuple(product(waveforms, velocities))


def simulate_gait(
    plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray, clock: ActionClock = PAPER_CLOCK
) -> GaitResponse:
    """Repeat a gait from rest, as in `steady_state_force`, and return the forces of the last
    window."""
    return _last_window(steady_state_force(plant, gait, cycles, key, clock), clock)


def simulate_gait_with_power(
    plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray, clock: ActionClock = PAPER_CLOCK
) -> GaitResponse:
    """Return the forces like `simulate_gait`, and the power, for a plant that `has_torque`."""
    commands = _repeated(plant, gait, cycles, clock)
    _, (reading, hidden) = hold(plant, plant.init(key), commands, clock, hold_action_with_hidden)
    power = mechanical_power(hidden.torque[:, :1], jnp.asarray(reading.velocity))
    mean_power = power[-clock.window_ticks :].mean()
    return _last_window(jnp.asarray(reading.force), clock)._replace(power=mean_power)


def _last_window(force: Float[Array, "ticks 2"], clock: ActionClock) -> GaitResponse:
    window = clock.window_ticks
    last = force[-window:]
    return GaitResponse(last.mean(axis=0), sobolev(last, jnp.int32(window)))


def steady_state_force(
    plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray, clock: ActionClock = PAPER_CLOCK
) -> Float[Array, "ticks 2"]:
    """Return the force at each tick of a gait that is repeated from rest for `cycles` windows [N].

    Windows shorter than 2 s are repeated for at least as long as windows of 2 s, because the time
    until the wake settles does not depend on the window.
    """
    commands = _repeated(plant, gait, cycles, clock)
    return jnp.asarray(hold(plant, plant.init(key), commands, clock)[1].force)


def _repeated(plant: Plant, gait: Gait, cycles: int, clock: ActionClock) -> Command:
    windows = max(cycles, math.ceil(cycles * PAPER_CLOCK.window_ticks / clock.window_ticks))
    actions = jnp.tile(jnp.asarray(gait), (windows, 1))
    return jax.vmap(lambda action: action_to_command(plant.limits, action))(actions)


SimulateGait = Callable[[Plant, Gait, int, PRNGKeyArray, ActionClock], GaitResponse]
"""`simulate_gait` or `simulate_gait_with_power`."""


class GaitSensitivity(NamedTuple):
    """Mean forces and costs of gaits, with their gradients."""

    pre_tanh: PreTanh
    out: Float[AnyArray, "gaits outputs"]
    """Mean force (x, y) and the sum of both Sobolev terms [N], and the mean power [W] if it is
    minimized."""
    slope: Float[AnyArray, "gaits outputs values"]
    """Gradient of `out` with respect to `pre_tanh`."""
    smoothness: Float[AnyArray, "gaits 2"]
    """Sobolev terms (x, y) [N]."""


def action_to_pre_tanh(gaits: Float[np.ndarray, "gaits actions 2"]) -> PreTanh:
    """Return the atanh of the actions of gaits, clipped to `MAX_SEARCHED_ACTION`."""
    limited = np.clip(gaits, -MAX_SEARCHED_ACTION, MAX_SEARCHED_ACTION)
    return np.asarray(np.arctanh(limited).reshape(len(gaits), -1))


def gait_sensitivity(
    plant: Plant,
    pre_tanh: PreTanh,
    cycles: int,
    key: PRNGKeyArray,
    clock: ActionClock,
    simulate: SimulateGait = simulate_gait,
) -> GaitSensitivity:
    """Simulate gaits; also return the gradients of their forces, and of their power if `simulate`
    returns it."""

    def simulate_batch(batch: PreTanh) -> GaitSensitivity:
        sensitivity: GaitSensitivity = jax.tree.map(
            np.asarray, _respond(plant, jnp.asarray(batch), cycles, key, clock, simulate)
        )
        return sensitivity

    parts = map_in_threads(simulate_batch, _batches(np.asarray(pre_tanh), SIDE_BY_SIDE))
    found: GaitSensitivity = jax.tree.map(lambda *x: np.concatenate(x)[: len(pre_tanh)], *parts)
    return found


def _batches(rows: np.ndarray, size: int) -> np.ndarray:
    """Split rows into batches of equal size, so that they share a compiled program; the last batch
    is padded with the first rows."""
    return np.resize(rows, (-(-len(rows) // size), size, *rows.shape[1:]))


@jit("low")
def _respond(
    plant: Plant,
    pre_tanh: Float[Array, "gaits values"],
    cycles: int,
    key: PRNGKeyArray,
    clock: ActionClock,
    simulate: SimulateGait,
) -> GaitSensitivity:
    def out(pre_tanh: Float[Array, "values"]) -> tuple[Float[Array, "outputs"], Float[Array, "2"]]:
        got = simulate(plant, jnp.tanh(pre_tanh).reshape(-1, 2), cycles, key, clock)
        outputs = [got.force, got.smoothness.sum()[None]]
        if got.power is not None:
            outputs.append(got.power[None])
        return jnp.concatenate(outputs), got.smoothness

    def each(pre_tanh: Float[Array, "values"]) -> GaitSensitivity:
        # Reverse mode, because there are 3 or 4 outputs and at least 12 inputs.
        value, pull, smoothness = jax.vjp(out, pre_tanh, has_aux=True)
        slope = jax.vmap(lambda way: pull(way)[0])(jnp.eye(len(value)))
        return GaitSensitivity(pre_tanh, value, slope, smoothness)

    found: GaitSensitivity = jax.vmap(each)(pre_tanh)
    return found


def missing_gradient(plant: Plant) -> str | None:
    """Return the reason why the force of a plant has no gradient with respect to its commands; None
    if there is a gradient.

    Raises:
        PlantError: If the plant itself fails.
    """
    strokes = action_to_pre_tanh(np.array([[(0.475, 1), (-0.475, 1)] * 3], np.float32))
    try:
        slope = gait_sensitivity(plant, strokes, CYCLES, jax.random.key(0), PAPER_CLOCK).slope[
            :, :2
        ]
    except (TypeError, ValueError, NotImplementedError) as error:
        # JAX raises these errors if a function is not differentiable.
        first_line = str(error).partition("\n")[0]
        return f"JAX cannot differentiate it ({type(error).__name__}: {first_line})"
    if not np.isfinite(slope).all():
        return "its gradient is not finite (like that of a square root at 0)"
    return None if slope.any() else "its gradient is 0"


class SurveyConfig(Configuration):
    """Configuration of the survey of reachable forces."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Number of windows for which a gait is repeated from rest; more if windows are shorter than 2
    s. Only the last window is evaluated."""
    batch: PositiveInt = 128
    """Number of gaits simulated together."""
    directions: int = Field(default=32, ge=8)
    """Number of corners of the region."""
    pushes: int = Field(default=8, ge=0)
    """Number of gradient steps that push each corner outwards; 0 keeps the farthest force in the
    grid."""


class Survey(NamedTuple):
    """Forces of the simulated gaits, and the reachable region of the fin."""

    force: Float[np.ndarray, "families centres amplitudes 2"]
    """Mean force over a window [N]."""
    reachable: Reachable
    clock: ActionClock
    """Clock of the gaits."""
    power: Float[np.ndarray, "families centres amplitudes"] | None = None
    """Mean power over a window [W]; None if not computed."""
    velocities: Sequence[float] = VELOCITIES
    """Velocities of the families (`gait_families`)."""


def strokes(
    waveform: Float[np.ndarray, "actions"],
    velocity: float,
    centre: Float[np.ndarray, "n"],
    amplitude: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n actions 2"]:
    """Return gaits of one family as actions."""
    angle = np.clip(centre[:, None] + amplitude[:, None] * waveform, -1, 1)
    return np.stack([angle, np.full_like(angle, velocity)], axis=-1).astype(np.float32)


def survey(
    plant: Plant,
    config: SurveyConfig | None = None,
    report: ReportSearch = lambda *_: None,
    clock: ActionClock = PAPER_CLOCK,
    simulate: SimulateGait = simulate_gait,
    velocities: Sequence[float] = VELOCITIES,
) -> Survey:
    """Simulate the gaits of all families in a plant and estimate the region of reachable forces;
    also return the power if `simulate` returns it."""
    config = config or SurveyConfig()
    places = np.array(list(product(CENTRES, AMPLITUDES))).T
    families = gait_families(clock, velocities)
    gaits = np.concatenate([strokes(*family, *places) for family in families])
    force, power = simulate_gaits(
        plant, gaits, config, clock, simulate, lambda done, note: report(0.8 * done, note)
    )
    reachable = _pushed(plant, gaits, force, config, clock)
    report(1.0, "")
    shape = (len(families), len(CENTRES), len(AMPLITUDES))
    if power is not None:
        power = power.reshape(shape)
    return Survey(force.reshape(*shape, 2), reachable, clock, power, velocities)


def simulate_gaits(
    plant: Plant,
    gaits: Float[np.ndarray, "n actions 2"],
    config: SurveyConfig,
    clock: ActionClock,
    simulate: SimulateGait,
    report: ReportSearch = lambda *_: None,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"] | None]:
    """Return the mean force [N] and, if `simulate` returns it, the mean power of each gait [W]."""
    responses = []
    for index, part in enumerate(_batches(gaits, config.batch), start=1):
        response = _mean_responses(plant, jnp.asarray(part), config.cycles, clock, simulate)
        responses.append(jax.tree.map(np.asarray, response))
        done = min(index * config.batch, len(gaits))
        report(done / len(gaits), f"{done} of {len(gaits)} gaits")
    means: tuple[np.ndarray, np.ndarray | None] = jax.tree.map(
        lambda *x: np.concatenate(x)[: len(gaits)], *responses
    )
    return means


@jit("low")
def _mean_responses(
    plant: Plant,
    gaits: Float[Array, "n actions 2"],
    cycles: int,
    clock: ActionClock,
    simulate: SimulateGait,
) -> Any:
    def one(gait: Float[Array, "actions 2"]) -> tuple[Array, Array | None]:
        response = simulate(plant, gait, cycles, named_key(0, "survey"), clock)
        return response.force, response.power

    return jax.vmap(one)(gaits)


def _pushed(
    plant: Plant,
    gaits: Float[np.ndarray, "n actions 2"],
    force: Float[np.ndarray, "n 2"],
    config: SurveyConfig,
    clock: ActionClock,
) -> Reachable:
    """Push the force of the farthest gait in each direction further outwards, and return the region
    of all forces.

    Directions start at the middle of all forces. Each step follows the gradient of the distance
    along the direction, in the atanh of the actions. The length of a step does not depend on the
    magnitude of the gradient.
    """
    centre = _middle(force)
    outward = directions(config.directions)
    if config.pushes == 0:
        # No gradient is computed because the plant may have none.
        return _star(force, centre, outward)
    offset = force - centre
    aside = np.abs(_cross(offset[:, None], outward))
    pre_tanh = action_to_pre_tanh(gaits[np.argmax(offset @ outward.T - ASIDE * aside, axis=0)])
    forces = [force]
    # The step length decreases; the last round has length 0 and only records the final forces.
    for part in (*np.linspace(1.0, 0.2, config.pushes), 0.0):
        found = gait_sensitivity(plant, pre_tanh, config.cycles, named_key(0, "survey"), clock)
        forces.append(np.asarray(found.out)[:, :2])
        side = np.sign(_cross(forces[-1] - centre, outward))[:, None]
        # The gradient of (distance along the direction) - ASIDE * (distance across it).
        uphill = outward - ASIDE * side * np.stack([outward[:, 1], -outward[:, 0]], axis=1)
        change = np.einsum("di,din->dn", uphill, np.asarray(found.slope)[:, :2])
        length = np.linalg.norm(change, axis=1, keepdims=True)
        # A gait without a gradient does not move.
        pre_tanh = pre_tanh + np.float32(0.5 * part) * change / np.where(length > 0, length, 1)
    return _star(np.concatenate(forces), centre, outward)


def _star(
    force: Float[np.ndarray, "n 2"],
    centre: Float[np.ndarray, "2"],
    outward: Float[np.ndarray, "directions 2"],
) -> Reachable:
    """Return the region that contains all forces: each radius is the maximum distance along its
    direction over the forces in the sector around it."""
    offset = force - centre
    along = offset @ outward.T
    length = np.linalg.norm(offset, axis=1)
    radius = np.where(along >= np.cos(np.pi / len(outward)) * length[:, None], along, 0).max(axis=0)
    return Reachable(centre.astype(np.float32), np.asarray(radius, np.float32))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of plane vectors: the signed distance of a from the line along the
    unit vector b."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _middle(force: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Return the middle of the bounding box of all forces, or the force nearest to it if no force
    is close."""
    low = force.min(axis=0)
    high = force.max(axis=0)
    middle = (low + high) / 2
    apart = np.linalg.norm(force - middle, axis=1)
    is_near = apart.min() <= NEAR * np.linalg.norm(high - low) / 2
    return np.asarray(middle if is_near else force[apart.argmin()])
