"""A fin's strokes: their mean force is the one asked for, in every direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import Command
from softfin.robot.fin_driver import REST, stroke
from softfin.tank import Tank
from softfin.tank.fin import Mount


def test_gaits_begin_at_rest_and_grow(gaits):
    assert gaits[0].force[0] == 0
    assert (np.diff(gaits[0].force) > 0).all()
    assert gaits[0].reach > 3.5


@jax.jit
def simulated(commands, velocity):
    """Forces of a fin that is towed [N]."""
    tank = Tank()
    mount = Mount(velocity, jnp.zeros(2), jnp.zeros(()))

    def tick(state, command):
        state, _, load = tank.tick(state, command, mount)
        return state, load.force

    return jax.lax.scan(tick, tank.init(jax.random.key(0)), commands)[1]


def mean_force(gaits, force, velocity=(0.0, 0.0)):
    state = REST
    commands = []
    for action in range(24):
        state, command = stroke(gaits, state, force, 1 if action % 2 == 0 else -1)
        commands.append(command)
    each_tick = Command(
        *(np.repeat(part, PAPER_CLOCK.action_ticks(24)) for part in zip(*commands, strict=True))
    )
    found = np.asarray(simulated(jax.tree.map(jnp.float32, each_tick), jnp.asarray(velocity)))
    return found[-PAPER_CLOCK.window_ticks :].mean(axis=0)


@pytest.mark.parametrize("force", [(1.5, 0.0), (-1.0, 2.0), (0.0, -3.0)])
def test_strokes_make_the_mean_force_asked_for(gaits, force):
    np.testing.assert_allclose(mean_force(gaits[0], force), force, atol=0.06)


@pytest.mark.parametrize("velocity", [(0.08, 0.0), (0.0, 0.06), (-0.05, -0.03)])
def test_a_fin_makes_up_for_the_force_that_motion_costs_it(gaits, velocity):
    force = np.array([-1.0, 2.0])
    lost = gaits[0].lost(force, np.array(velocity))
    assert np.linalg.norm(mean_force(gaits[0], force, velocity) - force) > 0.15
    np.testing.assert_allclose(mean_force(gaits[0], force + lost, velocity), force, atol=0.1)


def test_a_fin_swings_round_the_shorter_way(gaits):
    state, _ = stroke(gaits[0], REST, (-1.0, 0.1), 1)
    assert abs(state.direction) < np.pi
    further, _ = stroke(gaits[0], state, (-1.0, -0.1), 1)
    assert abs(further.direction - state.direction) == pytest.approx(0.2, abs=0.01)


def test_a_force_of_zero_keeps_the_direction(gaits):
    state, _ = stroke(gaits[0], REST, (0.0, 1.0), 1)
    rested, command = stroke(gaits[0], state, (0.0, 0.0), -1)
    assert rested.direction == state.direction
    assert command.angle == pytest.approx(state.direction)
