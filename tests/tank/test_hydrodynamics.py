import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.tank import chain
from softfin.tank.chain import Motion
from softfin.tank.fin import Fin, FinConfig, Shaft
from softfin.tank.hydrodynamics import Water, WaterConfig

RIGID = FinConfig(plates=4, length_m=0.2, span_m=0.08, youngs_modulus_pa=1e11)
CONFIG = WaterConfig(temperature_c=20.0, drag_coefficient=2.0, added_mass_coefficient=1.0)
DENSITY = 998.2067
ADDED = DENSITY * np.pi / 4 * 0.08**2


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def water():
    return Water(CONFIG, RIGID)


def turning(rate):
    pose = chain.pose(jnp.full(4, 0.4), jnp.asarray(0.05))
    return pose, chain.motion(pose, jnp.full(4, rate))


def test_the_drag_moment_of_a_turning_plate_is_its_integral(water):
    pose, motion = turning(3.0)
    resistance, _ = water.loads(motion)
    moment = chain.project(pose, resistance.times(motion)).sum()
    assert moment == pytest.approx(0.5 * DENSITY * 2.0 * 0.08 * 3.0**2 * 0.2**4 / 4, rel=1e-3)


def test_the_added_moment_of_inertia_of_a_plate_is_its_integral(water):
    pose, motion = turning(1.0)
    moment = chain.project(pose, water.inertia().times(motion)).sum()
    assert moment == pytest.approx(ADDED * 0.2**3 / 3, rel=1e-6)


def test_a_plate_that_slides_along_itself_meets_blasius_friction_alone(water):
    sliding = Motion(jnp.zeros(4), jnp.full(4, 0.3), jnp.zeros(4))
    resistance, suction = water.loads(sliding)
    force = resistance.times(sliding)
    reynolds = 0.3 * 0.2 / 1.0034e-6
    both_faces = 2 * 0.5 * DENSITY * 0.3**2 * 1.328 / np.sqrt(reynolds) * 0.2 * 0.08
    assert force.along.sum() == pytest.approx(both_faces, rel=2e-3)
    assert float(jnp.abs(force.normal).max()) == 0.0
    assert float(jnp.abs(suction.along).max()) == 0.0


def test_the_mean_thrust_of_a_rigid_beating_fin_is_lighthills(water):
    fin = Fin(RIGID)
    inertia = jax.tree.map(jnp.add, fin.inertia, water.inertia())
    amplitude, circular, steps = 0.5, 2 * np.pi, 2000
    seconds = 1 / steps
    times = np.arange(steps + 1) * seconds
    angle = amplitude * np.sin(circular * times)
    shafts = Shaft(*map(jnp.asarray, ((angle[1:] + angle[:-1]) / 2, np.diff(angle) / seconds)))
    start = fin.rest()._replace(rates=jnp.full(4, amplitude * circular))
    end, forces = jax.jit(
        lambda: jax.lax.scan(lambda state, shaft: fin.step(state, shaft, inertia, water.loads, seconds), start, shafts)
    )()
    mean = forces.mean(0) - (fin.momentum(end, inertia) - fin.momentum(start, inertia))
    bessel = 0.2422684577
    thrust = 0.5 * ADDED * 0.2**2 * circular**2 * amplitude * bessel
    assert mean[0] == pytest.approx(thrust, rel=0.01)
    assert mean[1] == pytest.approx(0.0, abs=0.01 * thrust)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=12, max_size=12))
def test_the_loads_never_feed_energy_into_the_fin(numbers):
    with jax.enable_x64(True):
        water = Water(CONFIG, RIGID)
        motion = Motion(*jnp.asarray(numbers).reshape(3, 4))
        resistance, suction = water.loads(motion)
        power = sum((f * v).sum() for f, v in zip(suction, motion, strict=True))
        power -= sum((f * v).sum() for f, v in zip(resistance.times(motion), motion, strict=True))
        assert power <= 1e-12


@pytest.mark.parametrize(("temperature", "density", "viscosity"), [(10, 999.70, 1.3065e-6), (20, 998.21, 1.0034e-6)])
def test_density_and_viscosity_are_those_of_fresh_water(temperature, density, viscosity):
    water = Water(WaterConfig(temperature_c=temperature, drag_coefficient=2.0, friction_coefficient=1.0), RIGID)
    assert water.drag[0] / 0.08 == pytest.approx(density, rel=1e-5)
    assert (water.friction[0] / (water.drag[0])) ** 2 * 0.2 == pytest.approx(viscosity, rel=6e-3)


def test_water_brought_to_a_temperature_is_water_configured_at_it(water):
    warm = water.at(jnp.asarray(30.0))
    configured = Water(CONFIG.model_copy(update={"temperature_c": 30.0}), RIGID)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), warm, configured)


def test_the_tip_term_can_be_left_out():
    water = Water(WaterConfig(tip_coefficient=0.0), RIGID)
    assert float(jnp.abs(water.loads(turning(2.0)[1])[1].along).max()) == 0.0
