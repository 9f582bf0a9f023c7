"""What can this fin do? Many gaits are tried in a plant, and the edge of what they make is pushed outwards.

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
from softfin.gaits.simulate import CYCLES, Family, Made, families, made, raw_of, response


class SurveyConfig(Configuration):
    """How the reachable forces are searched for."""

    cycles: int = Field(default=CYCLES, ge=2)
    """Windows that a gait is repeated for from rest; the last one counts."""
    batch: PositiveInt = 128
    """Gaits that are tried side by side."""
    directions: int = Field(default=32, ge=8)
    """Corners of the region."""
    pushes: int = Field(default=12, ge=0)
    """Gradient steps by which each corner is pushed outwards; 0 keeps the farthest of the tried ones."""


class Survey(NamedTuple):
    """What was tried and what it made."""

    families: list[Family]
    force: Float[np.ndarray, "families members 2"]
    """Mean over a window [N]."""
    smoothness: Float[np.ndarray, "families members 2"]
    """Sobolev term in the form `mean` [N]."""
    reachable: Reachable
    edge: Float[np.ndarray, "directions 6 2"]
    """Gaits that make the corners."""


def survey(
    plant: Plant, config: SurveyConfig | None = None, report: Callable[[float, str], None] | None = None
) -> Survey:
    """Try all families on a plant and find the edge of what it can do."""
    config, plant = config or SurveyConfig(), jit_argument(plant)
    tried = families()
    gaits = np.concatenate([family.gaits for family in tried])
    forces, smoothness = [], []
    for start in range(0, len(gaits), config.batch):
        part = gaits[start : start + config.batch]
        padded = np.concatenate([part, np.repeat(part[-1:], config.batch - len(part), axis=0)])
        got = _made(plant, jnp.asarray(padded), config.cycles)
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
    """The farthest gait in each direction, pushed on; directions are seen from the middle of what was made."""
    centre = _middle(force)
    outward = directions(config.directions)
    offset = force - centre
    along = offset @ outward.T
    aside = np.abs(offset[:, :1] * outward[:, 1] - offset[:, 1:] * outward[:, 0])
    start = gaits[np.argmax(along - ASIDE * aside, axis=0)]
    pushed, made_there = _push(plant, start, centre, config)
    everything = np.concatenate([force, made_there])
    return Reachable(centre.astype(np.float32), _radius(everything - centre, outward)), pushed


def _middle(force: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """The middle of the box round all forces; where no gait comes near it, the force that comes nearest."""
    low, high = force.min(axis=0), force.max(axis=0)
    middle = (low + high) / 2
    apart = np.linalg.norm(force - middle, axis=1)
    nearest: Float[np.ndarray, 2] = force[apart.argmin()]
    return middle if apart.min() <= NEAR * np.linalg.norm(high - low) / 2 else nearest


NEAR = 0.2
"""Part of half the diagonal of all forces within which a gait counts as near to their middle."""

ASIDE = 2.0
"""A newton beside the direction costs as much as this many along it."""


def _radius(offset: Float[np.ndarray, "n 2"], outward: Float[np.ndarray, "directions 2"]) -> Float[np.ndarray, "d"]:
    """How far the made forces go in each direction: the farthest along it of those in the sector about it."""
    half = np.cos(np.pi / len(outward))
    length = np.linalg.norm(offset, axis=1)
    inside = (offset @ outward.T) >= half * length[:, None]
    along = np.where(inside, offset @ outward.T, 0)
    return np.asarray(along.max(axis=0), np.float32)


@eqx.filter_jit
def _made(plant: Plant, gaits: Float[Array, "n 6 2"], cycles: int) -> Made:
    return jax.vmap(lambda gait: made(plant, gait, cycles, key_of(0, "survey")))(gaits)


def _push(
    plant: Plant, gaits: Float[np.ndarray, "d 6 2"], centre: Float[np.ndarray, "2"], config: SurveyConfig
) -> tuple[Float[np.ndarray, "d 6 2"], Float[np.ndarray, "forces 2"]]:
    """Gradient ascent of the distance along each direction, in the atanh of the actions, by steps of a fixed length.

    Also every force that was made on the way.
    """
    outward = directions(config.directions)
    raw = raw_of(gaits)
    made_there = []
    for part in (*np.linspace(1.0, 0.2, config.pushes), 0.0):
        found = response(plant, raw, config.cycles, key_of(0, "survey"))
        force, slope = np.asarray(found.out)[:, :2], np.asarray(found.slope)[:, :2]
        made_there.append(force)
        offset = force - centre
        side = np.sign(offset[:, 0] * outward[:, 1] - offset[:, 1] * outward[:, 0])[:, None]
        # Of the distance along the direction, less `ASIDE` times that beside it.
        uphill = outward - ASIDE * side * np.stack([outward[:, 1], -outward[:, 0]], axis=1)
        change = np.einsum("di,din->dn", uphill, slope)
        raw = raw + np.float32(0.5 * part) * change / (np.linalg.norm(change, axis=1, keepdims=True) + 1e-6)
    return np.tanh(raw).reshape(gaits.shape), np.concatenate(made_there)
