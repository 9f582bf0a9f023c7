"""Estimates the reachable mean forces: simulates a grid of gaits, then pushes the boundary outwards by gradient ascent.

A plant goes in, a Survey of gaits and their mean forces and the region of reachable mean forces come out.
"""

from itertools import product
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
from softfin.gaits.simulate import CYCLES, Report, gait_sensitivity, pre_tanh_of, simulate_gait

WAVEFORMS = np.array([(1, -1, 1, -1, 1, -1), (1, -1, -1, 1, -1, -1), (1, 0.5, -0.5, -1, -0.5, 0.5)])
"""Angles of a gait about its centre, in units of its amplitude: strokes of 0.67 s, 1 s and 2 s."""

VELOCITIES, CENTRES, AMPLITUDES = (1.0, 0.3, -0.3), np.linspace(-1, 1, 11), np.linspace(0.05, 0.9, 7)
"""What every waveform is tried with, as actions."""

NEAR = 0.2
"""Part of half the diagonal of all forces within which a gait counts as near to their middle."""

ASIDE = 2.0
"""A newton beside the direction costs as much as this many along it."""


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

    gaits: Float[np.ndarray, "waveforms gaits 6 2"]
    force: Float[np.ndarray, "waveforms gaits 2"]
    """Mean force over a window [N]."""
    reachable: Reachable


def tried_gaits() -> Float[np.ndarray, "waveforms gaits 6 2"]:
    """Return all gaits that a survey tries: of one waveform, neighbouring forces come from neighbouring gaits."""
    rest = list(product(VELOCITIES, CENTRES, AMPLITUDES))
    angles = np.clip([[c + a * waveform for _, c, a in rest] for waveform in WAVEFORMS], -1, 1)
    velocities = np.broadcast_to(np.array([v for v, *_ in rest])[:, None], angles.shape)
    return np.stack([angles, velocities], axis=-1).astype(np.float32)


def survey(plant: Plant, config: SurveyConfig | None = None, report: Report = lambda *_: None) -> Survey:
    """Simulate all gaits in a plant and find the edge of the forces that it can make."""
    config, plant = config or SurveyConfig(), jit_argument(plant)
    tried = tried_gaits()
    gaits = tried.reshape(-1, *tried.shape[2:])
    forces = []
    for start in range(0, len(gaits), config.batch):
        part = gaits[start : start + config.batch]
        padded = np.concatenate([part, np.repeat(part[-1:], config.batch - len(part), axis=0)])
        forces.append(np.asarray(_mean_forces(plant, jnp.asarray(padded), config.cycles))[: len(part)])
        report(0.8 * (start + len(part)) / len(gaits), f"{start + len(part)} of {len(gaits)} gaits")
    force = np.concatenate(forces)
    reachable = _pushed(plant, gaits, force, config)
    report(1.0, "")
    return Survey(tried, force.reshape(*tried.shape[:2], 2), reachable)


@eqx.filter_jit
def _mean_forces(plant: Plant, gaits: Float[Array, "n 6 2"], cycles: int) -> Float[Array, "n 2"]:
    return jax.vmap(lambda gait: simulate_gait(plant, gait, cycles, key_of(0, "survey")).force)(gaits)


def _pushed(
    plant: Plant, gaits: Float[np.ndarray, "n 6 2"], force: Float[np.ndarray, "n 2"], config: SurveyConfig
) -> Reachable:
    """Push the farthest gait in each direction on; directions are seen from the middle of all forces.

    It ascends the gradient of the distance along the direction, in the atanh of the actions, by steps of fixed length.
    """
    centre, outward = _middle(force), directions(config.directions)
    offset = force - centre
    aside = np.abs(offset[:, :1] * outward[:, 1] - offset[:, 1:] * outward[:, 0])
    pre_tanh = pre_tanh_of(gaits[np.argmax(offset @ outward.T - ASIDE * aside, axis=0)])
    made = [force]
    for part in (*np.linspace(1.0, 0.2, config.pushes), 0.0):
        found = gait_sensitivity(plant, pre_tanh, config.cycles, key_of(0, "survey"))
        made.append(np.asarray(found.out)[:, :2])
        offset = made[-1] - centre
        side = np.sign(offset[:, 0] * outward[:, 1] - offset[:, 1] * outward[:, 0])[:, None]
        # Of the distance along the direction, less `ASIDE` times that beside it.
        uphill = outward - ASIDE * side * np.stack([outward[:, 1], -outward[:, 0]], axis=1)
        change = np.einsum("di,din->dn", uphill, np.asarray(found.slope)[:, :2])
        pre_tanh = pre_tanh + np.float32(0.5 * part) * change / (np.linalg.norm(change, axis=1, keepdims=True) + 1e-6)
    # The greatest distance in each direction, over the forces in the sector about it.
    offset = np.concatenate(made) - centre
    along, length = offset @ outward.T, np.linalg.norm(offset, axis=1)
    radius = np.where(along >= np.cos(np.pi / len(outward)) * length[:, None], along, 0).max(axis=0)
    return Reachable(centre.astype(np.float32), np.asarray(radius, np.float32))


def _middle(force: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Return the middle of the box round all forces; where no gait comes near it, the force that comes nearest."""
    low, high = force.min(axis=0), force.max(axis=0)
    middle = (low + high) / 2
    apart = np.linalg.norm(force - middle, axis=1)
    return np.asarray(middle if apart.min() <= NEAR * np.linalg.norm(high - low) / 2 else force[apart.argmin()])
