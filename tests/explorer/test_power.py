"""The power in the page is that of softfin.core.power, for the same torques and velocities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.power import EC_MAX_30, Motor, drive_power
from softfin.core.quantities import PAPER_LIMITS, Command
from softfin.explorer.contents import plant_data
from softfin.surrogate import StreamingSurrogate
from softfin.surrogate.streaming.ensemble import Member, PowerInterval
from softfin.surrogate.streaming.torque import replace_torque
from softfin.tank import Tank, TankConfig
from tests.explorer import fins, node
from tests.surrogate.streaming import small

CLOSED = """
const make = { tank: Tank, surrogate: StreamingSurrogate }[input.plant.kind];
let command;
const controller = { description: { rest_rad: 0 }, act: () => command };
const loop = new Loop({ own: new make(input.plant) }, "own", controller, [0, 0]);
output = input.commands.map(([angle, velocity]) => {
  command = { angle, velocity };
  const reading = loop.tick();
  return [reading.torque, reading.motorTorque ?? null, reading.velocity, loop.power(), ...loop.mean()];
});
"""


@pytest.mark.parametrize("motor", [EC_MAX_30, Motor(2.0, 0.0, 1.0)], ids=["EC-max", "ideal"])
def test_the_power_of_torques_and_velocities_is_that_of_softfin(motor):
    random = np.random.default_rng(6)
    torque = random.normal(0, 1, (400, 2))
    velocity = random.normal(0, 4, 400)
    page = node.run(
        """
        let before = input.velocity[0];
        output = input.velocity.map((velocity, k) => {
          const [torque, motorTorque] = input.torque[k];
          const power = drivePower({ torque, motorTorque, velocity }, before, input.motor);
          before = velocity;
          return power;
        });
        """,
        torque=torque.tolist(),
        velocity=velocity.tolist(),
        motor=motor._asdict(),
    )
    expected = drive_power(torque, velocity, motor)
    assert 50 < (expected[:, 1] == 0).sum() < 350
    np.testing.assert_allclose(page, expected, rtol=1e-6)


def played(plant):
    """Torques, velocity, mean power and mean force in the page after each command."""
    commands = np.stack(small.commands(600, seed=7), axis=1).astype(float).tolist()
    return np.array(node.run(CLOSED, plant=plant_data("it", plant), commands=commands), float)


def test_the_mean_power_of_the_tank_is_that_of_its_motor_over_the_window():
    page = played(Tank(TankConfig(sensor=fins.QUIET)))
    assert np.isnan(page[:199, 3]).all()
    power = drive_power(page[:, :2], page[:, 2])[:, 1]
    for tick in (199, 350, 599):
        expected = power[tick - 199 : tick + 1].mean()
        assert expected > 0.5
        np.testing.assert_allclose(page[tick, 3], expected, rtol=1e-6)


def with_torque():
    surrogate = small.surrogate()
    members = surrogate.members
    numbers = np.random.default_rng(8).normal(0, 0.3, (surrogate.size, small.FORCE.odd_features))
    nets = replace_torque(members.force, jnp.asarray(numbers, jnp.float32))
    interval = PowerInterval(coverage=0.9, factor=1.6, floor_w=0.1, windows=10, logs=10)
    parts = (surrogate.interval, surrogate.familiarity, interval)
    return StreamingSurrogate(Member(members.drive, nets), PAPER_LIMITS, *parts)


def torques(surrogate, commands):
    """Torque on the fin and velocity after each command, in double precision."""

    def one(member, state, commands):
        def step(state, command):
            state, (motion, _) = member.step(state, Command(*command))
            torque = member.force.torque @ state.force.odd_features()
            return state, jnp.stack([torque, motion.velocity])

        return jax.lax.scan(step, state, commands)[1]

    with fins.doubles():
        doubles = fins.as_doubles((surrogate.members, surrogate.rest, commands))
        return np.asarray(jax.jit(jax.vmap(one, (0, 0, None)))(*doubles)).mean(axis=0)


def test_a_surrogate_with_torque_has_its_mechanical_power():
    surrogate = with_torque()
    page = played(surrogate)
    # The loop asks for a command at the start of each action only.
    starts = np.cumsum([0] + [33, 33, 34] * 6)
    held = np.searchsorted(starts, np.arange(600), side="right") - 1
    commands = [part[starts[held]] for part in small.commands(600, seed=7)]
    np.testing.assert_allclose(page[:, [0, 2]], torques(surrogate, commands), atol=1e-6)
    assert page[:, 0].std() > 0.1
    motor = np.full(600, np.nan)
    powers = drive_power(np.stack([page[:, 0], motor], axis=1), page[:, 2])
    np.testing.assert_allclose(page[-1, 3], powers[-200:, 0].mean(), rtol=1e-6)


def test_a_surrogate_without_torque_has_no_power():
    assert np.isnan(played(small.surrogate())[:, [0, 3]]).all()
