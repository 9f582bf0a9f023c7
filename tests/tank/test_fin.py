import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

from softfin.tank import chain
from softfin.tank.chain import Moments, PlateWrench
from softfin.tank.fin import BRACKET_BENDING_N_M, Fin, FinConfig, FinState, Shaft, Surroundings

SIZES = {"length_m": 0.2, "root_length_m": 0, "root_thickness_m": 0.019, "tip_thickness_ratio": 0.4}
PLAIN = FinConfig(**SIZES, youngs_modulus_pa=7e6, density_kg_m3=1150.0, damping_s=0.02)
UNIFORM = {"tip_thickness_ratio": 1.0, "damping_s": 0.0}


def config_of(**changes):
    return PLAIN.model_copy(update=changes)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def held(angle=0.0, play=0.0):
    return Shaft(jnp.asarray(angle), jnp.asarray(play), lambda load, drag: jnp.zeros_like(load))


def vacuum(fin, push=None):
    """Where nothing loads the plates, or a wrench does."""
    zero = jnp.zeros_like(fin.stiffness)
    none = Moments(zero, zero, zero, zero)
    return Surroundings(
        none, jnp.zeros(2), lambda motion: (none, push or PlateWrench(zero, zero, zero))
    )


def energy_of(fin, state):
    """Kinetic and elastic, in vacuum, with the shaft at angle 0 and without play [J]."""
    motion = chain.motion(chain.pose(state.angles, fin.plate_length), state.rates)
    kinetic = sum((p * v).sum() for p, v in zip(fin.inertia.times(motion), motion, strict=True)) / 2
    return kinetic + (fin.stiffness * jnp.diff(state.angles, prepend=0.0) ** 2).sum() / 2


@functools.partial(jax.jit, static_argnames=("steps", "seconds"))
def swing(fin, state, steps, seconds, tip_load=0.0):
    """In vacuum with the shaft held at angle 0: the states after each step, and the energies from
    the start on.

    On the tip there is a dead load along y in the axes of the tank [N].
    """
    last = jnp.eye(fin.stiffness.size)[-1]

    def step(state, _):
        across = tip_load * jnp.cos(state.angles) * last
        along = tip_load * jnp.sin(state.angles) * last
        push = PlateWrench(across, along, across * fin.plate_length)
        after, _, _ = fin.step(state, held(), vacuum(fin, push), seconds)
        return after, (after, energy_of(fin, state))

    end, (states, energies) = jax.lax.scan(step, state, length=steps)
    return states, jnp.append(energies, energy_of(fin, end))


def bent(fin, rate):
    plates = fin.stiffness.size
    return fin.rest()._replace(rates=jnp.asarray(rate * np.linspace(0.2, 1, plates) ** 2))


def test_energy_is_kept_in_vacuum_without_damping():
    fin = Fin(config_of(**UNIFORM, plates=4))
    states, energy = swing(fin, bent(fin, 20.0), 50_000, 2e-4)
    assert np.abs(states.angles).max() > 0.2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-3)


def test_structural_damping_takes_energy_out():
    fin = Fin(config_of(damping_s=0.005))
    _, energy = swing(fin, bent(fin, 10.0), 2000, 1e-3)
    assert energy[-1] < 1e-3 * energy[0]


@pytest.mark.parametrize(
    ("damping", "rates", "growth"), [(0.0273, (5.0, 40.0), 1e-6), (0.0, (1.0, 10.0), 0.15)]
)
def test_at_the_default_step_energy_in_vacuum_grows_no_more_than_documented(damping, rates, growth):
    fin = Fin(FinConfig(damping_s=damping))
    for rate in rates:
        _, energy = swing(fin, bent(fin, rate), 2000, 5e-3)
        assert energy.max() < (1 + growth) * energy[0]


def beam_frequencies(config):
    """Of the clamped uniform beam in vacuum, the first two [rad/s] (Euler-Bernoulli)."""
    bending = config.youngs_modulus_pa * config.root_thickness_m**2 / 12
    wave = np.sqrt(bending / (config.density_kg_m3 * config.length_m**4))
    return np.array([1.875104, 4.694091]) ** 2 * wave


def test_the_first_two_frequencies_are_those_of_a_clamped_beam():
    config = config_of(**UNIFORM, plates=12)
    fin = Fin(config)
    mass = chain.momentum_matrix(chain.pose(jnp.zeros(12), fin.plate_length), fin.inertia)
    bends = np.eye(12) - np.eye(12, k=-1)
    circular = np.sqrt(eigh(bends.T @ np.diag(fin.stiffness) @ bends, mass, eigvals_only=True))
    np.testing.assert_allclose(circular[:2], beam_frequencies(config), rtol=0.01)


def test_a_plucked_fin_rings_at_its_first_two_frequencies():
    config = config_of(**UNIFORM, plates=12)
    fin = Fin(config)
    tip = np.asarray(swing(fin, bent(fin, 0.01), 20_000, 1e-4)[0].angles[:, -1])
    spectrum = np.abs(np.fft.rfft(tip * np.hanning(tip.size), 16 * tip.size))
    circular = 2 * np.pi * np.fft.rfftfreq(16 * tip.size, 1e-4)
    for expected in beam_frequencies(config):
        near = (circular > 0.7 * expected) & (circular < 1.3 * expected)
        assert circular[near][spectrum[near].argmax()] == pytest.approx(expected, rel=0.02)


def test_a_small_load_on_the_tip_deflects_a_taper_as_the_beams_integral_says():
    config = config_of(damping_s=0.5, plates=4)
    fin = Fin(config)
    force = 0.01
    angles = swing(fin, fin.rest(), 4000, 5e-3, force)[0].angles[-1]
    along = np.linspace(0, config.length_m, 100_001)
    bending = config.youngs_modulus_pa * config.span_m * config.thickness(along) ** 3 / 12
    expected = force * np.trapezoid((config.length_m - along) ** 2 / bending, along)
    assert fin.plate_length * jnp.sin(angles).sum() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("load", "across", "along"),
    [(1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064), (5.0, 0.71379, 0.38763)],
)
def test_a_large_load_on_the_tip_makes_an_elastica(load, across, along):
    # Bisshopp and Drucker (1945): deflection and shortening over length, at load times length
    # squared over EI.
    config = config_of(tip_thickness_ratio=1.0, damping_s=0.5, plates=12)
    fin = Fin(config)
    bending = config.youngs_modulus_pa * config.span_m * config.root_thickness_m**3 / 12
    states, _ = swing(fin, fin.rest(), 4000, 5e-3, load * bending / config.length_m**2)
    x, y = fin.shape(jax.tree.map(lambda x: x[-1], states))[-1] / config.length_m
    assert y == pytest.approx(across, rel=0.01)
    assert 1 + x == pytest.approx(along, rel=0.01)


def test_the_bracket_makes_the_root_as_stiff_as_aluminium():
    plain = config_of(plates=4)
    config = plain.model_copy(update={"root_length_m": 0.06})
    with_bracket = Fin(config)
    without = Fin(plain)
    ratio = np.asarray(with_bracket.stiffness / without.stiffness)
    assert ratio[0] == pytest.approx(1 + BRACKET_BENDING_N_M / (7e6 * 0.0185**3 / 12), rel=0.1)
    assert 1.2 < ratio[1] < 5.0
    np.testing.assert_allclose(ratio[2:], 1.0)


@pytest.mark.parametrize("play", [0.0, 0.05])
def test_fin_and_free_rotor_keep_their_angular_momentum(play):
    fin = Fin(config_of(damping_s=0.0, plates=3))
    rotor = 0.01
    seconds = 5e-4

    def step(moving, _):
        state, angle, before = moving

        def turn(load, drag):
            return (rotor * before + load * seconds / 2) / (rotor + drag * seconds / 2)

        state, rate, _ = fin.step(
            state, Shaft(angle, jnp.asarray(play), turn), vacuum(fin), seconds
        )
        after = 2 * rate - before
        momentum = (
            chain.momentum_matrix(chain.pose(state.angles, fin.plate_length), fin.inertia)
            @ state.rates
        ).sum()
        return (state, angle + seconds * rate, after), (momentum + rotor * after, after)

    start = (bent(fin, 5.0), jnp.asarray(0.0), jnp.asarray(0.0))
    total, rotor_rates = jax.jit(lambda: jax.lax.scan(step, start, length=2000)[1])()
    assert np.abs(rotor_rates).max() > 0.1
    np.testing.assert_allclose(total, total[0], rtol=1e-3)


def test_within_its_play_the_root_bears_nothing_and_at_its_edge_it_holds():
    fin = Fin(config_of(plates=2, damping_s=0.1))
    play = 0.1
    moment = jnp.asarray([0.05, 0.0])
    shaft = held(play=play)

    @jax.jit
    def pushed(state, steps, moment):
        around = vacuum(fin, PlateWrench(0 * moment, 0 * moment, moment))
        return jax.lax.fori_loop(
            0, steps, lambda _, state: fin.step(state, shaft, around, 5e-3)[0], state
        ).angles

    assert pushed(fin.rest(), 4, moment)[0] == pytest.approx(pushed(fin.rest(), 4, -moment)[0] * -1)
    drifting = pushed(fin.rest()._replace(rates=jnp.full(2, 0.5)), 10, 0 * moment)
    np.testing.assert_allclose(drifting, 0.5 * 10 * 5e-3, rtol=1e-3)
    for sign in (1, -1):
        strained = float(moment[0] / fin.stiffness[0])
        assert sign * pushed(fin.rest(), 4000, sign * moment)[0] == pytest.approx(
            play / 2 + strained, rel=1e-3
        )


def test_a_fin_held_at_an_angle_ends_up_straight_along_it():
    fin = Fin(config_of(damping_s=0.02))
    state = fin.rest()
    step = jax.jit(lambda state: fin.step(state, held(0.7), vacuum(fin), 5e-3)[0])
    for _ in range(600):
        state = step(state)
    np.testing.assert_allclose(state.angles, 0.7, atol=1e-4)


def test_the_state_at_rest_is_straight_and_still():
    state = Fin(config_of(plates=3)).rest()
    assert isinstance(state, FinState)
    assert all(np.array_equal(part, np.zeros(3)) for part in state)
