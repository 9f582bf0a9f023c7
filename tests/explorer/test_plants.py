"""The plants in the page move as softfin's own do."""

import json

import jax
import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.core.plant import roll
from softfin.explorer.contents import plant_data, surrogate_data, tank_data
from softfin.tank import Tank, TankConfig
from tests.explorer import fins, node
from tests.plants import AnalyticFin
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

TICKS = 3000
"""30 s of moving commands."""

ROLL = """
const make = { tank: Tank, surrogate: StreamingSurrogate }[input.plant.kind], plant = new make(input.plant);
output = input.commands.map(([angle, velocity], tick) => {
  if (tick === input.pushed) plant.push([0.1, -0.4]);
  if (input.factors) [plant.stiffness, plant.drag] = input.factors[tick];
  const reading = plant.tick({ angle, velocity });
  return [reading.angle, reading.velocity, ...reading.force, reading.torque || 0, reading.motorTorque ?? 0, plant.distance ? plant.distance() : 0,
    ...(plant.halfWidth ? [0, 1].map((axis) => plant.halfWidth(reading.forces.map((force) => force[axis]))) : [0, 0])];
});
"""


def moved(plant, commands, **given):
    rows = np.stack(commands, axis=1).astype(float).tolist()
    return np.array(node.run(ROLL, plant=plant, commands=rows, **given))


def test_a_surrogate_moves_as_in_double_precision_and_nearly_as_in_single():
    surrogate = small.surrogate()
    commands = small.commands(TICKS, seed=1)
    page = moved(surrogate_data(surrogate), commands)
    rest, roll_doubles = fins.roll_surrogate(surrogate)
    _, reading, forces = roll_doubles(rest, commands)
    np.testing.assert_allclose(page[:, :4], reading, atol=1e-6, rtol=0)
    assert np.abs(page[:, 2:4]).max() > 1
    half_width = surrogate.interval.half_width(forces)
    np.testing.assert_allclose(page[:, 7:], half_width, atol=1e-6)

    start = surrogate.init(jax.random.key(0))
    after, reading = jax.jit(lambda state, commands: roll(surrogate, state, commands))(
        start, commands
    )
    np.testing.assert_allclose(page[:, 2:4], reading.force, atol=1e-4)
    np.testing.assert_allclose(page[-1, 6], surrogate.distance(after), rtol=1e-4)


@pytest.mark.parametrize(
    "config", [TankConfig(sensor=fins.QUIET), fins.UNUSUAL], ids=["default", "unusual"]
)
def test_a_tank_moves_as_in_double_precision_and_nearly_as_in_single(config):
    tank = Tank(config)
    commands = small.commands(500, seed=2)
    page = moved(tank_data(tank), commands)
    np.testing.assert_allclose(page[:, :6], fins.roll_tank(tank, commands, double=True), atol=1e-9)
    # The rounding of single precision depends on how XLA divides a program.
    np.testing.assert_allclose(
        page[:, 2:4], fins.roll_tank(tank, commands, double=False)[:, 2:4], atol=2e-3
    )
    assert np.abs(page[:, 2:4]).max() > 2


@pytest.mark.parametrize(
    "config", [TankConfig(sensor=fins.QUIET), fins.UNUSUAL], ids=["default", "unusual"]
)
def test_a_fin_that_changes_while_it_beats_moves_as_the_tank_with_those_parameters(config):
    """Force and torque, from the tick of the change on."""
    tank = Tank(config)
    commands = small.commands(600, seed=3)
    factors = np.repeat([[1, 1], [0.5, 1.5], [1.5, 1], [1.2, 0.5]], 150, axis=0).astype(np.float32)
    page = moved(tank_data(tank), commands, factors=factors.astype(float).tolist())
    expected = fins.roll_tank(tank, commands, double=True, factors=factors)
    np.testing.assert_allclose(page[:, :6], expected, atol=1e-7)
    apart = np.abs(expected - fins.roll_tank(tank, commands, double=True)).max(axis=1)
    assert (apart[:150] == 0).all()
    for start in (150, 300, 450):
        assert apart[start : start + 150].max() > 0.05


def test_a_push_moves_the_water_and_dies_down():
    tank = Tank(fins.UNUSUAL)
    commands = small.commands(1000, seed=4)
    calm, pushed = (moved(tank_data(tank), commands, pushed=tick) for tick in (None, 300))
    apart = np.abs(calm - pushed)[:, 2:4].max(axis=1)
    assert (apart[:300] == 0).all()
    assert apart[300:330].max() > 0.1
    assert apart[800:].max() < apart.max() / 10


@pytest.mark.parametrize(
    ("plant", "told"),
    [(paper.surrogate(), "a surrogate of kind 'paper'"), (AnalyticFin(), "a AnalyticFin")],
    ids=["windowed", "own"],
)
def test_another_plant_is_refused_with_the_ones_that_can_move(plant, told):
    with pytest.raises(PlantError) as refused:
        plant_data("mine", plant)
    assert str(refused.value).startswith(f"plant mine: {told} cannot run on the page")
    assert "--plant tank" in str(refused.value)


def test_the_data_are_numbers_and_texts():
    for plant in (small.surrogate(), Tank(fins.UNUSUAL)):
        json.dumps(plant_data("it", plant), allow_nan=False)
