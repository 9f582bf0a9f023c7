"""Estimates the reachable mean forces: simulates a grid of gaits, then pushes the boundary outwards by gradient ascent.

A plant goes in, a Survey of gaits and their mean forces and the region of reachable mean forces come out.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.plant import Plant
from softfin.core.plant_identity import jit_argument
from softfin.core.randomness import key_of
from softfin.gaits.reachable import Reachable, directions
from softfin.gaits.simulate import CYCLES, Family, GaitResponse, families, gait_sensitivity, pre_tanh_of, simulate_gait


class SurveyConfig(Configuration):
    """Configuration of the search for reachable forces."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Windows that a gait is repeated for from rest; the last one counts."""
    batch: PositiveInt = 128
    """Gaits that are simulated side by side."""
    directions: int = Field(default=32, ge=8)
    """Corners of the region."""
    pushes: int = Field(default=12, ge=0)
    """Gradient steps by which each corner is pushed outwards; 0 keeps the farthest of the tried ones."""


class Survey(NamedTuple):
    """Gaits that were simulated, and the forces that they made."""

    families: list[Family]
    force: Float[np.ndarray, "families members 2"]
    """Mean force over a window [N]."""
    smoothness: Float[np.ndarray, "families members 2"]
    """Sobolev term in the form `mean` [N]."""
    reachable: Reachable
    edge: Float[np.ndarray, "directions 6 2"]
    """Gaits that make the forces at the corners."""


def survey(
    plant: Plant, config: SurveyConfig | None = None, report: Callable[[float, str], None] | None = None
) -> Survey:
    """Simulate all families in a plant and find the edge of the forces that it can make."""
    config, plant = config or SurveyConfig(), jit_argument(plant)
    tried = families()
    gaits = np.concatenate([family.gaits for family in tried])
    forces, smoothness = [], []
    for start in range(0, len(gaits), config.batch):
        part = gaits[start : start + config.batch]
        padded = np.concatenate([part, np.repeat(part[-1:], config.batch - len(part), axis=0)])
        got = _simulated(plant, jnp.asarray(padded), config.cycles)
        forces.append(np.asarray(got.force)[: len(part)])
        smoothness.append(np.asarray(got.smoothness)[: len(part)])
        if report is not None:
            report(0.8 * (start + len(part)) / len(gaits), f"{start + len(part)} of {len(gaits)} gaits")
    force = np.concatenate(forces)
    reachable, edge = _pushed(plant, gaits, force, config)
    shape = len(tried), len(tried[0].gaits), 2
    if report is not None:
        report(1.0, "")
    return Survey(tried, force.reshape(shape), np.concatenate(smoothness).reshape(shape), reachable, edge)


def _pushed(
    plant: Plant, gaits: Float[np.ndarray, "n 6 2"], force: Float[np.ndarray, "n 2"], config: SurveyConfig
) -> tuple[Reachable, Float[np.ndarray, "directions 6 2"]]:
    """Push the farthest gait in each direction on; directions are seen from the middle of all forces."""
    centre = _middle(force)
    outward = directions(config.directions)
    offset = force - centre
    along = offset @ outward.T
    aside = np.abs(offset[:, :1] * outward[:, 1] - offset[:, 1:] * outward[:, 0])
    start = gaits[np.argmax(along - ASIDE * aside, axis=0)]
    pushed, on_the_way = _push(plant, start, centre, config)
    # The greatest distance in each direction, over the forces in the sector about it.
    offset = np.concatenate([force, on_the_way]) - centre
    along, length = offset @ outward.T, np.linalg.norm(offset, axis=1)
    radius = np.where(along >= np.cos(np.pi / len(outward)) * length[:, None], along, 0).max(axis=0)
    return Reachable(centre.astype(np.float32), np.asarray(radius, np.float32)), pushed


def _middle(force: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Return the middle of the box round all forces; where no gait comes near it, the force that comes nearest."""
    low, high = force.min(axis=0), force.max(axis=0)
    middle = (low + high) / 2
    apart = np.linalg.norm(force - middle, axis=1)
    nearest: Float[np.ndarray, 2] = force[apart.argmin()]
    return middle if apart.min() <= NEAR * np.linalg.norm(high - low) / 2 else nearest


NEAR = 0.2
"""Part of half the diagonal of all forces within which a gait counts as near to their middle."""

ASIDE = 2.0
"""A newton beside the direction costs as much as this many along it."""


@eqx.filter_jit
def _simulated(plant: Plant, gaits: Float[Array, "n 6 2"], cycles: int) -> GaitResponse:
    return jax.vmap(lambda gait: simulate_gait(plant, gait, cycles, key_of(0, "survey")))(gaits)


def _push(
    plant: Plant, gaits: Float[np.ndarray, "d 6 2"], centre: Float[np.ndarray, "2"], config: SurveyConfig
) -> tuple[Float[np.ndarray, "d 6 2"], Float[np.ndarray, "forces 2"]]:
    """Ascend the gradient of the distance along each direction, in the atanh of the actions, by steps of fixed length.

    Also returns every force that was made on the way.
    """
    outward = directions(config.directions)
    pre_tanh = pre_tanh_of(gaits)
    on_the_way = []
    for part in (*np.linspace(1.0, 0.2, config.pushes), 0.0):
        found = gait_sensitivity(plant, pre_tanh, config.cycles, key_of(0, "survey"))
        force, slope = np.asarray(found.out)[:, :2], np.asarray(found.slope)[:, :2]
        on_the_way.append(force)
        offset = force - centre
        side = np.sign(offset[:, 0] * outward[:, 1] - offset[:, 1] * outward[:, 0])[:, None]
        # Of the distance along the direction, less `ASIDE` times that beside it.
        uphill = outward - ASIDE * side * np.stack([outward[:, 1], -outward[:, 0]], axis=1)
        change = np.einsum("di,din->dn", uphill, slope)
        pre_tanh = pre_tanh + np.float32(0.5 * part) * change / (np.linalg.norm(change, axis=1, keepdims=True) + 1e-6)
    return np.tanh(pre_tanh).reshape(gaits.shape), np.concatenate(on_the_way)
