"""How open-loop baselines are found: sines and gaits tried on a plant, as a rule a surrogate, for each reference.

Commands are issued one a tick, so that a sine can be commanded; an action held for 33 ticks is 33 equal commands.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Key, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.plant import Plant, roll
from softfin.core.quantities import RATE_HZ, Command, Limits, Reading
from softfin.core.randomness import generator_of, key_of
from softfin.core.window import moving_error
from softfin.evaluation.baselines.sines import ShaftSine, fit_constant

Forces = Float[np.ndarray, "cases ticks 2"]
References = Float[np.ndarray, "references 2"]

CHUNK = 256
"""Cases that run side by side at most: one compiled program serves any greater number of them."""


class SearchConfig(Configuration):
    """Length and fineness of the search."""

    seconds: int = Field(default=8, ge=3)
    """Length of a trial from rest [s], whole; its first 2 s fill the first window."""
    frequencies_hz: tuple[PositiveFloat, ...] = Field(default=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0), min_length=1)
    """Frequencies of the sines [Hz]; whole periods fill the window of 2 s, so that its mean has no ripple."""
    centres: int = Field(default=13, ge=2)
    """Zero directions of the first lattice, over the angles that the plant takes."""
    amplitudes: int = Field(default=8, ge=2)
    """Amplitudes of the first lattice, up to `amplitude_max_rad`."""
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


class RandomGait(NamedTuple):
    """Six actions on the 33/33/34 clock, again and again."""

    angle: Float[np.ndarray, "*shape actions"]
    """Target angles [rad]."""
    velocity: Float[np.ndarray, "*shape actions"]
    """Target velocities [rad/s]."""

    def commands(self, seconds: int) -> Command:
        """One command a tick: fields ``(*shape, ticks)``."""
        actions = np.arange(CYCLE_ACTIONS * seconds) % CYCLE_ACTIONS
        rows = np.repeat(actions, ticks_of(len(actions)))[: seconds * RATE_HZ]
        return Command(*(part[..., rows].astype(np.float32) for part in self))


class OpenLoop:
    """A plant under series of commands, each from rest; `limits` are those that commands are to keep."""

    def __init__(self, plant: Plant, limits: Limits) -> None:
        self.plant, self.limits = plant, limits

        def one(command: Command, key: PRNGKeyArray) -> Reading:
            return roll(plant, plant.init(key), command)[1]

        self._each = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None)))
        self._force = jax.jit(jax.vmap(lambda command, key: one(command, key).force, in_axes=(0, None)))

    def readings(self, commands: Command, keys: Key[jax.Array, "seeds"]) -> Reading:
        """Readings of every series with every key of the plant: fields ``(cases, seeds, ticks)``."""
        readings: Reading = jax.tree.map(np.asarray, self._each(commands, keys))
        return readings

    def forces(self, commands: Command, key: PRNGKeyArray) -> Forces:
        """Forces of many series, all with one key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Filled up with repetitions of the last case, whose forces are dropped again.
        padded = Command(*(jnp.pad(part, ((0, -count % size), (0, 0)), mode="edge") for part in commands))
        parts = [self._force(Command(*(part[i : i + size] for part in padded)), key) for i in range(0, count, size)]
        return np.concatenate([np.asarray(part) for part in parts])[:count]

    def forces_of_sines(self, sines: Float[np.ndarray, "cases 3"], seconds: int, seed: int) -> Forces:
        """Forces of sines given by centre, amplitude and frequency."""
        command, *_ = ShaftSine(*sines.T).commands(self.limits, seconds * RATE_HZ)
        return self.forces(jax.tree.map(np.asarray, command), key_of(seed, "baselines/search"))


def force_errors(forces: Forces, references: References) -> Float[np.ndarray, "cases references"]:
    """Error of each case at each reference: those of x and y together [N], as in Table II."""
    return np.stack([moving_error(forces, reference).sum(axis=1) for reference in references], axis=1)


def best_sines(player: OpenLoop, references: References, config: SearchConfig, seed: int) -> ShaftSine:
    """The sine of least error for each reference: a lattice for all, then finer ones round the best of each."""
    limits = player.limits
    low = np.array([limits.angle_min, 0.0])
    high = np.array([limits.angle_max, config.amplitude_max_rad])
    step = (high - low) / [config.centres - 1, config.amplitudes]
    centres = np.linspace(limits.angle_min, limits.angle_max, config.centres)
    amplitudes = np.linspace(0, config.amplitude_max_rad, config.amplitudes + 1)[1:]
    lattice = np.array(list(itertools.product(centres, amplitudes, config.frequencies_hz)))
    errors = force_errors(player.forces_of_sines(lattice, config.seconds, seed), references)
    tried = [(lattice, error) for error in errors.T]
    for _ in range(config.refinements):
        step = step / 2
        near = [_around(points[np.argsort(error)[: config.kept]], step, low, high) for points, error in tried]
        forces = player.forces_of_sines(np.concatenate(near), config.seconds, seed)
        each = np.split(forces, np.cumsum([len(points) for points in near])[:-1])
        tried = [
            (np.concatenate([points, new]), np.concatenate([error, force_errors(force, reference[None])[:, 0]]))
            for (points, error), new, force, reference in zip(tried, near, each, references, strict=True)
        ]
    return ShaftSine(*np.stack([points[error.argmin()] for points, error in tried], axis=1))


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


def best_gaits(player: OpenLoop, references: References, config: SearchConfig, seed: int) -> RandomGait:
    """The gait of least error for each reference, of the same few random ones."""
    limits = player.limits
    generator = generator_of(seed, "baselines/gaits")
    shape = (config.gaits, CYCLE_ACTIONS)
    gaits = RandomGait(
        generator.uniform(limits.angle_min, limits.angle_max, shape),
        generator.uniform(limits.velocity_min, limits.velocity_max, shape),
    )
    forces = player.forces(gaits.commands(config.seconds), key_of(seed, "baselines/search"))
    best = force_errors(forces, references).argmin(axis=0)
    return RandomGait(*(part[best] for part in gaits))


def fitted_constant(
    player: OpenLoop, frequency: float, amplitudes: tuple[float, float], config: SearchConfig, seed: int
) -> float:
    """The inverse model's constant for the fin at hand [N s2]; raises RunError where the fin pulls."""
    amplitude = np.linspace(*amplitudes, config.trials)
    sines = np.stack([np.zeros_like(amplitude), amplitude, np.full_like(amplitude, frequency)], axis=1)
    forces = player.forces_of_sines(sines, config.seconds, seed)
    # At angle 0 thrust is along x. The first window shows how the fin starts.
    return fit_constant(amplitude, frequency, forces[:, 2 * RATE_HZ :, 0].mean(axis=1, dtype=np.float64))
