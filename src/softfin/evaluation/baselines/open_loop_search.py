"""How open-loop baselines are found: sines and gaits tried on a plant, as a rule a surrogate, for each reference."""

import itertools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.quantities import RATE_HZ, Command
from softfin.core.randomness import generator_of, key_of
from softfin.evaluation.baselines.inverse import recalibrated
from softfin.evaluation.baselines.open_loop import OpenLoop, missed
from softfin.evaluation.baselines.sine import Sine, commanded

References = Float[np.ndarray, "references 2"]


class SearchConfig(Configuration):
    """How long and how finely is searched."""

    seconds: int = Field(default=8, ge=3)
    """Length of a trial from rest [s], whole; its first 2 s fill the first window."""
    frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0), min_length=1)
    """Of the sines [Hz]; whole periods fill the window of 2 s, so that a steady beat leaves no ripple in its mean."""
    centres: int = Field(default=13, ge=2)
    """Zero directions of the first lattice, over the angles that the plant takes."""
    amplitudes: int = Field(default=8, ge=2)
    """Of the first lattice, up to `amplitude_max_rad`."""
    amplitude_max_rad: float = Field(default=1.5, gt=0, le=np.pi)
    """Greatest amplitude of a sine [rad]."""
    kept: PositiveInt = 4
    """Sines that are refined for each reference."""
    refinements: int = Field(default=4, ge=0)
    """Rounds; each halves the steps of centre and amplitude and tries the 5 x 5 sines round each kept one."""
    gaits: PositiveInt = 256
    """Random gaits of six actions: some 20 s of what a surrogate learnt from, as many as a look-up table might hold."""
    trials: int = Field(default=6, ge=1)
    """Sines straight ahead that the inverse model's constant is fitted to, over the driver's amplitudes."""


class Gait(NamedTuple):
    """Six actions on the 33/33/34 clock, again and again."""

    angle: Float[np.ndarray, "*shape actions"]
    """[rad]"""
    velocity: Float[np.ndarray, "*shape actions"]
    """[rad/s]"""

    def commands(self, seconds: int) -> Command:
        """One a tick: fields ``(*shape, ticks)``."""
        held = ticks_of(CYCLE_ACTIONS)
        cycles = -(-seconds * RATE_HZ // sum(held))

        def series(part: Float[np.ndarray, "*shape actions"]) -> Float[np.ndarray, "*shape ticks"]:
            cycle = np.repeat(part, held, axis=-1).astype(np.float32)
            return np.concatenate([cycle] * cycles, axis=-1)[..., : seconds * RATE_HZ]

        return Command(series(self.angle), series(self.velocity))


def best_sines(player: OpenLoop, references: References, config: SearchConfig, seed: int) -> Sine:
    """For each reference the sine that misses it least: a lattice for all, then finer ones round the best of each."""
    limits = player.limits
    low = np.array([limits.angle_min, 0.0])
    high = np.array([limits.angle_max, config.amplitude_max_rad])
    step = (high - low) / [config.centres - 1, config.amplitudes]
    centres = np.linspace(limits.angle_min, limits.angle_max, config.centres)
    amplitudes = np.linspace(0, config.amplitude_max_rad, config.amplitudes + 1)[1:]
    lattice = np.array(list(itertools.product(centres, amplitudes, config.frequencies_hz)))
    losses = missed(_forces_of_sines(player, lattice, config, seed), references)
    tried = [(lattice, loss) for loss in losses.T]
    for _ in range(config.refinements):
        step = step / 2
        near = [_around(points[np.argsort(loss)[: config.kept]], step, low, high) for points, loss in tried]
        forces = _forces_of_sines(player, np.concatenate(near), config, seed)
        each = np.split(forces, np.cumsum([len(points) for points in near])[:-1])
        tried = [
            (np.concatenate([points, new]), np.concatenate([loss, missed(force, reference[None])[:, 0]]))
            for (points, loss), new, force, reference in zip(tried, near, each, references, strict=True)
        ]
    return Sine(*np.stack([points[loss.argmin()] for points, loss in tried], axis=1))


def best_gaits(player: OpenLoop, references: References, config: SearchConfig, seed: int) -> Gait:
    """For each reference the gait, of the same few random ones, that misses it least."""
    limits = player.limits
    generator = generator_of(seed, "baselines/gaits")
    shape = (config.gaits, CYCLE_ACTIONS)
    gaits = Gait(
        generator.uniform(limits.angle_min, limits.angle_max, shape),
        generator.uniform(limits.velocity_min, limits.velocity_max, shape),
    )
    forces = player.forces(gaits.commands(config.seconds), key_of(seed, "baselines/search"))
    best = missed(forces, references).argmin(axis=0)
    return Gait(*(part[best] for part in gaits))


def fitted_constant(
    player: OpenLoop, frequency: float, amplitudes: tuple[float, float], config: SearchConfig, seed: int
) -> float:
    """The inverse model's constant for the fin at hand [N s2]; raises RunError where the fin pulls."""
    amplitude = np.linspace(*amplitudes, config.trials)
    sines = np.stack([np.zeros_like(amplitude), amplitude, np.full_like(amplitude, frequency)], axis=1)
    forces = _forces_of_sines(player, sines, config, seed)
    # At angle 0 thrust is along x. What the fin does in the first window is how it starts.
    thrust = forces[:, 2 * RATE_HZ :, 0].mean(axis=1, dtype=np.float64)
    return recalibrated(amplitude, frequency, thrust)


def _forces_of_sines(
    player: OpenLoop, sines: Float[np.ndarray, "cases 3"], config: SearchConfig, seed: int
) -> Float[np.ndarray, "cases ticks 2"]:
    command, _ = commanded(player.limits, Sine(*sines.T), config.seconds * RATE_HZ)
    return player.forces(jax.tree.map(np.asarray, command), key_of(seed, "baselines/search"))


def _around(
    points: Float[np.ndarray, "kept 3"],
    step: Float[np.ndarray, "2"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "near 3"]:
    """The 5 x 5 sines round each point, inside the box, at the point's frequency."""
    offsets = np.array(list(itertools.product(range(-2, 3), repeat=2))) * step
    near = np.clip(points[:, None, :2] + offsets, low, high)
    frequency = np.broadcast_to(points[:, None, 2:], (*near.shape[:2], 1))
    return np.concatenate([near, frequency], axis=2).reshape(-1, 3)
