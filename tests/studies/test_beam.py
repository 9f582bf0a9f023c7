"""The chain of plates against beam theory, and against recordings of a silicone beam where they are
at hand."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq
from studies.beam import CASES, GRAVITY_M_S2, LOAD_HEIGHT_M, SHEAR_FACTOR, SIZES, STEP_S

from softfin.core.errors import LogError
from softfin.tank import chain
from softfin.tank.fin import FinConfig
from studies import beam

MODULUS_PA = 3e5
POSITIONS = np.arange(3 * 2 * 3).reshape(3, 2, 3) / 8


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def c3d(number_format=84, scale=-1.0, analog=0, residual=0.0):
    """Three frames of two markers: a header, a block of parameters, the positions."""
    header = struct.pack("<2B5HfH", 2, 0x50, 2, analog, 1, 3, 10, scale, 3)
    parameters = bytes([0, 0, 1, number_format])
    rows = np.concatenate([POSITIONS, np.full((3, 2, 1), residual)], axis=2)
    return header.ljust(512, b"\0") + parameters.ljust(512, b"\0") + rows.astype("<f4").tobytes()


def test_positions_are_read_from_a_c3d_file(tmp_path):
    file = tmp_path / "beam.c3d"
    file.write_bytes(c3d())
    np.testing.assert_array_equal(beam.read_c3d(file), POSITIONS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time,x,y\n", "not a C3D file; export the recording as C3D"),
        (c3d(number_format=86), "must contain little-endian float positions"),
        (c3d(scale=0.1), "must contain little-endian float positions"),
        (c3d(analog=4), "must contain little-endian float positions"),
        (c3d()[:-1], "ends before frame 3; copy the file again"),
        (c3d(residual=-1.0), "a marker is missing in some frames; fill the gaps"),
    ],
)
def test_a_c3d_file_that_cannot_be_read_is_refused(tmp_path, content, message):
    file = tmp_path / "beam.c3d"
    file.write_bytes(content)
    with pytest.raises(LogError, match=f"beam.c3d: {message}"):
        beam.read_c3d(file)


def config_of(plates=12, damping_s=0.0):
    return FinConfig(plates=plates, youngs_modulus_pa=MODULUS_PA, damping_s=damping_s, **SIZES)


def cantilever_hz(load_n, is_stocky):
    """First frequency of a Timoshenko beam with a mass at its tip; of an Euler-Bernoulli beam,
    which is rigid in shear and whose sections have no rotary inertia."""
    width, height, length = SIZES["span_m"], SIZES["root_thickness_m"], SIZES["length_m"]
    area = width * height
    inertia = width * height**3 / 12
    bending = MODULUS_PA * inertia
    density = SIZES["density_kg_m3"]
    shear = SHEAR_FACTOR * MODULUS_PA / 3 * area
    mass = load_n / GRAVITY_M_S2

    def determinant(hz):
        square = (2 * np.pi * hz) ** 2
        # d/dx of deflection, section angle, moment and shear force.
        along = np.zeros((4, 4))
        along[0, 1] = along[2, 3] = 1
        along[1, 2] = 1 / bending
        along[2, 3] = -1
        along[3, 0] = -density * area * square
        if is_stocky:
            along[0, 3] = 1 / shear
            along[2, 1] = -density * inertia * square
        tip = expm(along * length)[:, 2:]
        # The tip mass takes its force and, as it sits above the axis, a moment.
        return np.linalg.det(
            [
                tip[2] - mass * LOAD_HEIGHT_M**2 * square * tip[1],
                tip[3] - mass * square * tip[0],
            ]
        )

    return brentq(determinant, 0.5, 20.0)


@pytest.mark.parametrize("is_stocky", [False, True])
@pytest.mark.parametrize("load_n", [0.0, 0.5, 1.0])
def test_the_first_frequency_is_that_of_a_cantilever(load_n, is_stocky):
    found = beam.natural_hz(beam.make_beam(config_of(), load_n, is_stocky))
    assert found == pytest.approx(cantilever_hz(load_n, is_stocky), rel=0.003)


def test_a_beam_released_near_its_rest_rings_at_its_first_frequency():
    config = config_of(plates=6, damping_s=1e-3)
    model = beam.make_beam(config, 0.0, is_stocky=True)
    place = np.array([(0.0, 0.01)] * 3)
    rest = beam.marker_motion(model, beam.rest_angles(model), place)[:, 1].mean()
    start = beam.held_angles(model, place, rest + 1e-4)
    angles = np.asarray(beam.release(model, start, round(1 / STEP_S)).angles)
    ring = beam.ring(beam.marker_motion(model, angles, place)[:: round(0.01 / STEP_S)], 7.0)
    natural = beam.natural_hz(model)
    assert ring.frequency_hz == pytest.approx(natural, rel=0.01)
    # A Kelvin-Voigt material: decay = (2 pi f)^2 T / 2.
    assert ring.decay_per_s == pytest.approx((2 * np.pi * natural) ** 2 * 1e-3 / 2, rel=0.02)


def energy_j(model, state, load_n):
    """Of the beam and of a weight, found from where the weight is and how fast it moves."""
    size = state.angles.size
    length = model.fin.plate_length
    bare = beam.make_beam(config_of(plates=size), 0.0, is_stocky=False).fin.inertia
    motion = chain.motion(chain.pose(state.angles, length), state.rates)
    kinetic = sum((p * v).sum() for p, v in zip(bare.times(motion), motion, strict=True)) / 2
    sine = jnp.sin(state.angles)
    inner = length * (jnp.cumsum(sine) - sine)
    weight = GRAVITY_M_S2 * (bare.zeroth * inner + bare.first * sine).sum()
    elastic = state.angles @ model.stiffness @ state.angles / 2

    def load_place(angles):
        end = length * jnp.stack([-jnp.cos(angles).sum(), jnp.sin(angles).sum()])
        return end + LOAD_HEIGHT_M * jnp.stack([jnp.sin(angles[-1]), jnp.cos(angles[-1])])

    place, velocity = jax.jvp(load_place, (state.angles,), (state.rates,))
    load = load_n * place[1] + load_n / GRAVITY_M_S2 * (velocity**2).sum() / 2
    return kinetic + weight + elastic + load


def test_a_weight_above_the_axis_adds_no_energy():
    load_n = 1.0
    model = beam.make_beam(config_of(plates=4, damping_s=5e-4), load_n, is_stocky=False)
    states = beam.release(model, jnp.zeros(4), round(0.5 / STEP_S))
    energies = np.asarray(jax.vmap(lambda state: energy_j(model, state, load_n))(states))
    assert states.angles[:, -1].min() < -0.5
    bending = np.diff(states.rates, axis=1, prepend=0.0)
    power = (np.asarray(model.fin.damping) * ((bending[1:] + bending[:-1]) / 2) ** 2).sum(axis=1)
    lost = STEP_S * power.cumsum()
    # The weight falls by 60 mm, so its energy changes by 0.06 J.
    assert lost[-1] > 1e-3
    np.testing.assert_allclose(energies[1:] + lost, energies[0], atol=1e-4)


def test_the_tank_predicts_the_frequencies_of_a_beam_from_its_recordings_without_a_weight(measured):
    recordings = beam.load_all(measured / "beam")
    # The first of two repetitions is enough.
    config = beam.fit(recordings["gravity"][:1], is_stocky=False)
    assert config.youngs_modulus_pa == pytest.approx(beam.PUBLISHED_MODULUS_PA, rel=0.1)
    for case in CASES:
        model = beam.make_beam(config, case.load_n, is_stocky=False)
        recording = recordings[case.name][0]
        found = beam.evaluate(model, recording)
        expected = beam.ring(beam.window(recording), found.ring.frequency_hz)
        assert found.ring.frequency_hz == pytest.approx(expected.frequency_hz, rel=0.05)
        assert beam.rms_distance(found.rest - recording.rest) < 4e-3
