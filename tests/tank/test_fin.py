import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.errors import ConfigurationError
from softfin.tank.chain import Moments, Wrench
from softfin.tank.fin import Fin, FinConfig, FinState, Shaft

UNIFORM = {"tip_thickness_ratio": 1.0, "damping_s": 0.0}


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def nothing(motion):
    zero = jnp.zeros_like(motion.turning)
    return Moments(zero, zero, zero, zero), Wrench(zero, zero, zero)


def swing(fin, state, steps, seconds, loads=nothing):
    """In vacuum with the shaft held at angle 0: the states after each step."""
    still = Shaft(jnp.asarray(0.0), jnp.asarray(0.0))

    def step(state, _):
        state, _ = fin.step(state, still, fin.inertia, loads, seconds)
        return state, state

    return jax.jit(lambda state: jax.lax.scan(step, state, length=steps)[1])(state)


def bent(fin, rate):
    plates = fin.stiffness.size
    return fin.rest()._replace(rates=jnp.asarray(rate * np.linspace(0.2, 1, plates) ** 2))


def test_energy_is_kept_in_vacuum_without_damping():
    fin = Fin(FinConfig(**UNIFORM, plates=4))
    start = bent(fin, 20.0)
    states = swing(fin, start, 50_000, 2e-4)
    energy = jax.vmap(lambda state: fin.energy(state, jnp.asarray(0.0), fin.inertia))(states)
    before = fin.energy(start, jnp.asarray(0.0), fin.inertia)
    assert np.abs(states.angles).max() > 0.2
    np.testing.assert_allclose(energy, before, rtol=1e-3)


def test_structural_damping_takes_energy_out():
    fin = Fin(FinConfig(damping_s=0.005))
    states = swing(fin, bent(fin, 10.0), 2000, 1e-3)
    energy = jax.vmap(lambda state: fin.energy(state, jnp.asarray(0.0), fin.inertia))(states)
    assert energy[-1] < 1e-3 * energy[0]


def test_the_first_bending_frequency_is_that_of_a_clamped_beam():
    config = FinConfig(**UNIFORM, plates=12)
    fin = Fin(config)
    states = swing(fin, bent(fin, 0.01), 20_000, 1e-4)
    tip = np.asarray(states.angles[:, -1])
    spectrum = np.abs(np.fft.rfft(tip * np.hanning(tip.size), 16 * tip.size))
    found = np.fft.rfftfreq(16 * tip.size, 1e-4)[spectrum.argmax()]
    bending = config.youngs_modulus_pa * config.root_thickness_m**2 / 12
    expected = 1.875104**2 / (2 * np.pi) * np.sqrt(bending / (config.density_kg_m3 * config.length_m**4))
    assert found == pytest.approx(expected, rel=0.02)


def test_a_small_load_on_the_tip_deflects_it_as_it_does_a_cantilever():
    config = FinConfig(tip_thickness_ratio=1.0, damping_s=0.5, plates=12)
    fin = Fin(config)
    last = jnp.eye(12)[-1]
    force, plate = 0.01, config.length_m / 12

    def push(motion):
        resistance, zero = nothing(motion)
        return resistance, zero._replace(normal=force * last, moment=force * plate * last)

    angles = swing(fin, fin.rest(), 4000, 5e-3, push).angles[-1]
    bending = config.youngs_modulus_pa * config.span_m * config.root_thickness_m**3 / 12
    assert plate * jnp.sin(angles).sum() == pytest.approx(force * config.length_m**3 / (3 * bending), rel=0.01)


def test_joints_of_a_taper_are_those_of_the_beam_between_the_plates():
    fin = Fin(FinConfig(tip_thickness_ratio=0.4, plates=8))
    config = FinConfig()
    along = np.linspace(0, config.length_m * 7.5 / 8, 100_001)
    thickness = config.root_thickness_m * (1 - 0.6 * along / config.length_m)
    bending = config.youngs_modulus_pa * config.span_m * thickness**3 / 12
    assert float((1 / fin.stiffness).sum()) == pytest.approx(np.trapezoid(1 / bending, along), rel=1e-3)


def test_a_fin_held_at_an_angle_ends_up_straight_along_it():
    fin = Fin(FinConfig())
    held = Shaft(jnp.asarray(0.7), jnp.asarray(0.0))
    state = fin.rest()
    step = jax.jit(lambda state: fin.step(state, held, fin.inertia, nothing, 5e-3)[0])
    for _ in range(600):
        state = step(state)
    np.testing.assert_allclose(state.angles, 0.7, atol=1e-4)


def test_a_fin_of_negative_thickness_is_refused_by_name():
    with pytest.raises(ConfigurationError, match=r"fin: root_thickness_m = -0.01: Input should be greater than 0"):
        FinConfig.build({"root_thickness_m": -0.01}, "fin")


def test_the_state_at_rest_is_straight_and_still():
    state = Fin(FinConfig(plates=3)).rest()
    assert isinstance(state, FinState)
    assert all(np.array_equal(part, np.zeros(3)) for part in state)
