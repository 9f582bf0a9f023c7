import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.quantities import TICK_S
from softfin.tank import chain
from softfin.tank.chain import PlateMotion
from softfin.tank.fin import Fin, FinConfig, Shaft
from softfin.tank.hydrodynamics import REFERENCE_STROKE, Water, WaterConfig

RIGID = FinConfig(plates=4, length_m=0.2, span_m=0.08, youngs_modulus_pa=1e11)
CONFIG = WaterConfig(
    temperature_c=20.0, drag_coefficient=2.0, added_mass_coefficient=1.0, tip_coefficient=1.0
)
DENSITY = 998.2067
ADDED = DENSITY * np.pi / 4 * 0.08**2


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def water():
    return Water(CONFIG, RIGID)


def still(water):
    return water.around(water.rest())


def prescribed(fin, water, rates, seconds, angle=0.0, rate=0.0):
    """A fin whose shaft turns at mean `rates` [rad/s] in steps: end state, forces and moments on
    the shaft."""
    around = still(water)

    def step(carry, turning):
        state, angle = carry
        moments = []

        def turn(load, drag):
            moments.append(load - drag * turning)
            return turning

        state, _, force = fin.step(state, Shaft(angle, jnp.asarray(0.0), turn), around, seconds)
        return (state, angle + seconds * turning), (force, moments[-1])

    start = fin.rest()._replace(angles=jnp.full(4, float(angle)), rates=jnp.full(4, float(rate)))
    carry = (start, jnp.asarray(float(angle)))
    (end, _), (forces, moments) = jax.jit(lambda: jax.lax.scan(step, carry, jnp.asarray(rates)))()
    return start, end, forces, moments


def turning(rate):
    pose = chain.pose(jnp.full(4, 0.4), jnp.asarray(0.05))
    return pose, chain.motion(pose, jnp.full(4, rate))


def test_the_drag_moment_of_a_turning_plate_is_its_integral(water):
    pose, motion = turning(3.0)
    resistance, _ = still(water).loads(motion)
    moment = chain.project(pose, resistance.times(motion)).sum()
    assert moment == pytest.approx(0.5 * DENSITY * 2.0 * 0.08 * 3.0**2 * 0.2**4 / 4, rel=1e-3)


def test_the_added_moment_of_inertia_of_a_plate_is_its_integral(water):
    pose, motion = turning(1.0)
    moment = chain.project(pose, water.inertia.times(motion)).sum()
    assert moment == pytest.approx(ADDED * 0.2**3 / 3, rel=1e-6)


def test_a_plate_that_slides_along_itself_meets_blasius_friction_alone(water):
    sliding = PlateMotion(jnp.zeros(4), jnp.full(4, 0.3), jnp.zeros(4))
    resistance, suction = still(water).loads(sliding)
    force = resistance.times(sliding)
    reynolds = 0.3 * 0.2 / 1.0034e-6
    both_faces = 2 * 0.5 * DENSITY * 0.3**2 * 1.328 / np.sqrt(reynolds) * 0.2 * 0.08
    assert force.along.sum() == pytest.approx(both_faces, rel=2e-3)
    assert float(jnp.abs(force.normal).max()) == 0.0
    assert float(jnp.abs(suction.along).max()) == 0.0


def test_the_drag_moment_of_a_fin_turned_at_constant_speed_is_its_integral(water):
    rate = 3.0
    _, _, _, moments = prescribed(Fin(RIGID), water, np.full(400, rate), 1e-3, rate=rate)
    expected = -0.5 * DENSITY * 2.0 * 0.08 * rate**2 * 0.2**4 / 4
    assert moments[-1] == pytest.approx(expected, rel=0.01)


def test_a_fin_started_from_rest_feels_the_moment_of_its_own_and_the_added_mass():
    fin = Fin(RIGID)
    acceleration = 20.0
    seconds = 1e-4
    steps = 100
    frictionless = Water(CONFIG.model_copy(update={"drag_coefficient": 0.0}), RIGID)
    rates = acceleration * seconds * (np.arange(steps) + 0.5)
    _, _, _, moments = prescribed(fin, frictionless, rates, seconds)
    along = (np.arange(10_000) + 0.5) / 10_000 * 0.2
    own = (along**2 * RIGID.density_kg_m3 * 0.08 * RIGID.thickness(along)).mean() * 0.2
    expected = -acceleration * (own + ADDED * 0.2**3 / 3)
    assert moments[-50:].mean() == pytest.approx(expected, rel=0.01)


def test_the_mean_thrust_of_a_rigid_beating_fin_is_lighthills(water):
    fin = Fin(RIGID)
    amplitude = 0.5
    circular = 2 * np.pi
    steps = 2000
    seconds = 1 / steps
    rates = np.diff(amplitude * np.sin(circular * np.arange(steps + 1) * seconds)) / seconds
    start, end, forces, _ = prescribed(fin, water, rates, seconds, rate=amplitude * circular)
    before, after = (sum(fin.momenta(state, still(water))) for state in (start, end))
    mean = forces.mean(0) - (after - before)
    # Mean of m_tip w^2/2 along the fin, with J_1(0.5) from the Jacobi-Anger expansion of its
    # direction.
    bessel = 0.2422684577
    thrust = 0.5 * ADDED * 0.2**2 * circular**2 * amplitude * bessel
    assert mean[0] == pytest.approx(thrust, rel=0.02)
    assert mean[1] == pytest.approx(0.0, abs=0.01 * thrust)


def test_the_first_wet_frequency_of_a_plate_is_chus():
    # Chu (1963): f_water / f_vacuum = (1 + pi/4 rho_water span / (rho_plate thickness))^(-1/2).
    shape = {"length_m": 0.3, "root_length_m": 0.0, "span_m": 0.06, "root_thickness_m": 0.01}
    uniform = {"tip_thickness_ratio": 1.0, "youngs_modulus_pa": 7e6, "damping_s": 0.0}
    plate = FinConfig(plates=12, **shape, **uniform)
    fin = Fin(plate)
    water = Water(WaterConfig(added_mass_coefficient=1.0, drag_coefficient=0.0), plate)
    around = still(water)
    held = Shaft(jnp.asarray(0.0), jnp.asarray(0.0), lambda load, drag: jnp.zeros_like(load))

    def step(state, _):
        state, _, _ = fin.step(state, held, around, 5e-4)
        return state, state.angles[-1]

    plucked = fin.rest()._replace(rates=jnp.asarray(0.01 * np.linspace(0, 1, 12)))
    tip = np.asarray(jax.jit(lambda: jax.lax.scan(step, plucked, length=20_000)[1])())
    spectrum = np.abs(np.fft.rfft(tip * np.hanning(tip.size), 8 * tip.size))
    found = 2 * np.pi * np.fft.rfftfreq(8 * tip.size, 5e-4)[spectrum.argmax()]
    vacuum = 1.875104**2 * np.sqrt(7e6 * 0.01**2 / 12 / (1150.0 * 0.3**4))
    chu = vacuum / np.sqrt(1 + np.pi / 4 * DENSITY * 0.06 / (1150.0 * 0.01))
    assert found == pytest.approx(chu, rel=0.02)


def test_a_stream_past_a_fin_held_across_it_is_drag_alone(water):
    flow = water.rest()._replace(stream=jnp.array([0.0, 0.4]))
    around = water.around(flow)
    held = Shaft(jnp.asarray(0.0), jnp.asarray(0.0), lambda load, drag: jnp.zeros_like(load))
    fin = Fin(RIGID)
    state, _, force = jax.jit(lambda state: fin.step(state, held, around, 1e-3))(fin.rest())
    np.testing.assert_allclose(fin.momenta(state, around)[0], 0.0, atol=1e-4)
    pressure = 0.5 * DENSITY * 2.0 * 0.08 * 0.2 * 0.4**2
    assert force[1] == pytest.approx(pressure, rel=1e-3)
    # The suction at the tip pulls along the fin.
    assert force[0] == pytest.approx(0.5 * ADDED * 0.4**2, rel=0.01)


def test_what_the_fin_takes_the_stream_gives_and_then_it_dies_down():
    water = Water(WaterConfig(stream_mass_kg=10.0, stream_decay_s=4.0), RIGID)
    still_fin = PlateMotion(*(jnp.zeros(4),) * 3)
    flow = water.rest()
    for _ in range(5):
        flow = water.stirred(flow, still_fin, jnp.array([2.0, -1.0]))
    np.testing.assert_allclose(10.0 * flow.stream, -5 * TICK_S * np.array([2.0, -1.0]), rtol=0.01)
    for _ in range(400):
        flow = water.stirred(flow, still_fin, jnp.zeros(2))
    np.testing.assert_allclose(
        10.0 * flow.stream, -5 * TICK_S * np.array([2.0, -1.0]) * np.exp(-1), rtol=0.01
    )


@pytest.mark.parametrize("amplitude", [0.03, 0.1])
def test_drag_falls_with_the_stroke_as_grahams_power(amplitude):
    water = Water(WaterConfig(drag_coefficient=4.0, drag_exponent=1 / 3, wake_memory_s=2.0), RIGID)
    circular = 2 * np.pi * 1.5

    def tick(flow, time):
        normal = jnp.full(4, amplitude * circular * jnp.cos(circular * time))
        return water.stirred(
            flow, PlateMotion(normal, jnp.zeros(4), jnp.zeros(4)), jnp.zeros(2)
        ), flow.square

    flow, _ = jax.lax.scan(tick, water.rest(), np.arange(1200) * TICK_S)
    motion = PlateMotion(jnp.ones(4), jnp.zeros(4), jnp.zeros(4))
    found = water.around(flow).loads(motion)[0].zeroth / (0.5 * DENSITY * 0.08 * 0.05)
    number = 2 * np.pi * amplitude / 0.08
    np.testing.assert_allclose(found, 4.0 * (number / REFERENCE_STROKE) ** (-1 / 3), rtol=0.03)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=12, max_size=12))
def test_the_loads_never_feed_energy_into_the_fin(numbers):
    with jax.enable_x64(True):
        water = Water(CONFIG, RIGID)
        motion = PlateMotion(*jnp.asarray(numbers).reshape(3, 4))
        resistance, suction = still(water).loads(motion)
        power = sum((f * v).sum() for f, v in zip(suction, motion, strict=True))
        power -= sum((f * v).sum() for f, v in zip(resistance.times(motion), motion, strict=True))
        assert power <= 1e-12


@pytest.mark.parametrize(
    ("temperature", "density", "viscosity"), [(10, 999.70, 1.3065e-6), (20, 998.21, 1.0034e-6)]
)
def test_density_and_viscosity_are_those_of_fresh_water(temperature, density, viscosity):
    config = {"temperature_c": temperature, "drag_coefficient": 2, "friction_coefficient": 1}
    water = Water(WaterConfig.build(config), RIGID)
    assert water.drag[0] / 0.08 == pytest.approx(density, rel=1e-5)
    assert (water.friction[0] / (water.drag[0])) ** 2 * 0.2 == pytest.approx(viscosity, rel=6e-3)


def test_water_brought_to_a_temperature_is_water_configured_at_it(water):
    warm = water.varied(jnp.asarray(30.0))
    configured = Water(CONFIG.model_copy(update={"temperature_c": 30.0}), RIGID)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), warm, configured)


def test_the_tip_term_can_be_left_out():
    water = Water(WaterConfig(tip_coefficient=0.0), RIGID)
    assert float(jnp.abs(still(water).loads(turning(2.0)[1])[1].along).max()) == 0.0
