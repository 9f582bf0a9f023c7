import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.tank import chain
from softfin.tank.chain import Moments, PlateMotion, PlateWrench

PLATES = 5
LENGTH = 0.04
MASS = np.array([1.0, 0.9, 0.8, 0.7, 0.6])
ADDED = np.array([5.0, 6.0, 7.0, 6.5, 4.0])
"""Per length [kg/m]: of the plates, and of the water along their normals."""


def directions(angles):
    return jnp.stack([-jnp.cos(angles), jnp.sin(angles)], -1), jnp.stack(
        [jnp.sin(angles), jnp.cos(angles)], -1
    )


def velocities(angles, rates, points=200):
    """Of points along each plate, by summing the plates from the shaft: (plates, points, 2)."""
    _, normals = directions(angles)
    ends = jnp.cumsum(LENGTH * normals * rates[:, None], axis=0)
    inner = jnp.concatenate([jnp.zeros((1, 2)), ends[:-1]])
    along = (np.arange(points) + 0.5) / points * LENGTH
    return inner[:, None] + along[:, None] * (normals * rates[:, None])[:, None]


def kinetic(angles, rates):
    velocity = velocities(angles, rates)
    _, normals = directions(angles)
    across = jnp.einsum("ipk,ik->ip", velocity, normals)
    own = MASS[:, None] * (velocity**2).sum(-1)
    return 0.5 * LENGTH * (own + ADDED[:, None] * across**2).mean(1).sum()


def momentum(angles, rates):
    velocity = velocities(angles, rates)
    _, normals = directions(angles)
    across = jnp.einsum("ipk,ik->ip", velocity, normals)
    water = ADDED[:, None, None] * across[..., None] * normals[:, None]
    return LENGTH * (MASS[:, None, None] * velocity + water).mean(1).sum(0)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def moments():
    both = (MASS + ADDED) * LENGTH
    orders = (both, both * LENGTH / 2, both * LENGTH**2 / 3, MASS * LENGTH)
    return Moments(*map(jnp.asarray, orders))


@pytest.fixture
def moving():
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.uniform(-2, 2, PLATES)), jnp.asarray(rng.uniform(-5, 5, PLATES))


def test_the_mass_matrix_gives_the_kinetic_energy_of_every_point(moments, moving):
    angles, rates = moving
    matrix = chain.momentum_matrix(chain.pose(angles, jnp.asarray(LENGTH)), moments)
    np.testing.assert_allclose(0.5 * rates @ matrix @ rates, kinetic(angles, rates), rtol=1e-4)


def test_momentum_is_that_of_every_point(moments, moving):
    angles, rates = moving
    motion = chain.motion(chain.pose(angles, jnp.asarray(LENGTH)), rates)
    found = chain.resultant(angles, moments.times(motion))
    np.testing.assert_allclose(found, momentum(angles, rates), rtol=1e-4, atol=1e-6)


def test_momentum_projected_on_the_joints_is_the_mass_matrix_times_the_rates(moments, moving):
    angles, rates = moving
    pose = chain.pose(angles, jnp.asarray(LENGTH))
    projected = chain.project(pose, moments.times(chain.motion(pose, rates)))
    np.testing.assert_allclose(projected, chain.momentum_matrix(pose, moments) @ rates, rtol=1e-12)


def test_centripetal_moments_are_those_of_lagranges_equations(moments, moving):
    angles, rates = moving
    pose = chain.pose(angles, jnp.asarray(LENGTH))
    _, drift = jax.jvp(lambda q: jax.grad(kinetic, argnums=1)(q, rates), (angles,), (rates,))
    lagrange = jax.grad(kinetic)(angles, rates) - drift
    found = chain.project(pose, chain.centripetal(pose, moments, chain.motion(pose, rates)))
    np.testing.assert_allclose(found, lagrange, rtol=1e-4, atol=1e-5)


def test_centripetal_forces_are_the_loss_of_momentum_at_constant_rates(moments, moving):
    angles, rates = moving
    pose = chain.pose(angles, jnp.asarray(LENGTH))
    _, gained = jax.jvp(lambda q: momentum(q, rates), (angles,), (rates,))
    found = chain.resultant(angles, chain.centripetal(pose, moments, chain.motion(pose, rates)))
    np.testing.assert_allclose(found, -gained, rtol=1e-4, atol=1e-5)


def test_a_load_on_the_tip_turns_each_plate_by_its_lever():
    angles = jnp.zeros(PLATES)
    last = jnp.zeros(PLATES).at[-1].set(2.0)
    load = PlateWrench(last, jnp.zeros(PLATES), last * LENGTH)
    turning = chain.project(chain.pose(angles, jnp.asarray(LENGTH)), load)
    np.testing.assert_allclose(turning, 2.0 * LENGTH * np.ones(PLATES))


def test_a_plate_at_angle_theta_points_along_minus_cosine_and_sine():
    rigid = jnp.full(PLATES, 0.3)
    motion = chain.motion(chain.pose(rigid, jnp.asarray(LENGTH)), jnp.ones(PLATES))
    np.testing.assert_allclose(motion.normal, LENGTH * np.arange(PLATES), atol=1e-15)
    assert isinstance(motion, PlateMotion)
    pull = PlateWrench(jnp.zeros(PLATES), jnp.zeros(PLATES).at[0].set(1.0), jnp.zeros(PLATES))
    np.testing.assert_allclose(chain.resultant(rigid, pull), [-np.cos(0.3), np.sin(0.3)])


@pytest.mark.parametrize("size", [1, 2, 6])
def test_the_unrolled_solve_is_numpys_with_what_holds_the_root(size):
    rng = np.random.default_rng(size)
    half = rng.normal(size=(size, size))
    matrix = half @ half.T + 0.1 * np.eye(size)
    right = rng.normal(size=size)
    # The root is held by a damper of 0.5, pushed by 0.3.
    inertia, impulse, expand = chain.condense(*map(jnp.asarray, (matrix, right)))
    found = expand((impulse + 0.3) / (inertia + 0.5))
    first = np.eye(size)[0]
    expected = np.linalg.solve(matrix + 0.5 * np.outer(first, first), right + 0.3 * first)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_one_velocity_has_the_components_of_its_projections():
    velocity = jnp.array([0.3, -0.2])
    angles = jnp.linspace(-2, 2, PLATES)
    along, normal = directions(angles)
    found = chain.components(angles, velocity)
    np.testing.assert_allclose(found.normal, normal @ velocity, rtol=1e-12)
    np.testing.assert_allclose(found.along, along @ velocity, rtol=1e-12)
