"""Phases of the fins' strokes, chosen to cancel the ripple of the wrench. NumPy only.

A period of two strokes has six phases: a fin starts its strokes with the action or one or two
thirds of an action later, to one side or the other. Relative to the first fin, four fins have 216
patterns; the best is found by trying all of them.
"""

from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Complex, Float, Int

from softfin.core.action_clock import PAPER_CLOCK

NUM_PHASES = 6
DELAY_TICKS = PAPER_CLOCK.ticks[0] // 3
"""Delay between consecutive phases [ticks]."""

MUCH = 0.4
"""Fraction of the current ripple below which a new pattern's ripple must be to justify a change. A
fin that changes its phase misses a stroke, and a robot that keeps station needs a new wrench in
every action."""

METRES_PER_RADIAN = 2.0
"""Weight of attitude ripple relative to position ripple [m/rad]: one degree counts as much as 3.5
cm, because the fins tilt the body much more than they displace it."""

Phases = Int[np.ndarray, "fins"]


def phase_delay(phase: int) -> int:
    """Return the delay of a fin's strokes after the start of the action [ticks]."""
    return phase % 3 * DELAY_TICKS


def stroke_side(phase: int, action: int) -> int:
    """Return the side, 1 or -1, to which a fin strokes in an action; `action` counts from 0."""
    return 1 if (phase // 3 + action) % 2 == 0 else -1


@cache
def _patterns(
    count: int,
) -> tuple[Int[np.ndarray, "patterns fins"], Complex[np.ndarray, "patterns fins"]]:
    """Return all phase patterns relative to the first fin, and the complex factor of each fin's
    ripple."""
    phases = np.array([(0, *rest) for rest in product(range(NUM_PHASES), repeat=count - 1)])
    return phases, np.exp(-2j * np.pi / NUM_PHASES * phases)


def choose_phases(
    present: Phases,
    starting: bool,
    ripple: Complex[np.ndarray, "6 fins"],
    inverse_inertia: Float[np.ndarray, "6 6"],
) -> Phases:
    """Return the phases with the least body motion due to ripple; unless `starting`, keep the
    current ones if the gain is small."""
    # At a fixed frequency, displacements are proportional to accelerations.
    moved = inverse_inertia @ ripple
    moved[3:] *= METRES_PER_RADIAN
    phases, turns = _patterns(len(present))
    # Sum of squared amplitudes over the axes, for every pattern.
    costs = (np.abs(turns @ moved.T) ** 2).sum(axis=1)
    best = int(costs.argmin())
    part = 1.0 if starting else MUCH
    now = float((np.abs(moved @ np.exp(-2j * np.pi / NUM_PHASES * present)) ** 2).sum())
    return (present[0] + phases[best]) % NUM_PHASES if costs[best] < part**2 * now else present


def wrench_ripple(
    matrix: Float[np.ndarray, "6 columns"],
    shafts: Float[np.ndarray, "fins 3"],
    directions: Float[np.ndarray, "fins"],
    ripple: Complex[np.ndarray, "fins 2"],
) -> Complex[np.ndarray, "6 fins"]:
    """Return each fin's ripple as a complex wrench on the body, for strokes about directions
    [rad]."""
    # The direction across a fin's thrust (cos a, -sin a) is (sin a, cos a).
    across = np.stack([np.sin(directions), np.cos(directions)], axis=1)
    wrench: np.ndarray = np.einsum("afi,fi->af", matrix.reshape(6, -1, 2), across) * ripple[:, 0]
    wrench[3:] += shafts.T * ripple[:, 1]
    return wrench
