import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import CommandError
from softfin.core.plant import Plant, hold, roll
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command
from softfin.tank import IDEAL, SensorConfig, Tank, TankConfig, with_parameters
from softfin.tank.drive import DriveConfig
from softfin.tank.fin import FinConfig
from softfin.tank.hydrodynamics import WaterConfig

KEY = jax.random.key(0)
QUIET = TankConfig(sensor=IDEAL)
COARSE = Tank(TankConfig(fin=FinConfig(plates=2)))
"""Where the number of plates does not matter: it compiles faster."""
STILL = WaterConfig(stream_decay_s=0.0, tip_coefficient=1.0)
TICKS = 1000
"""Of every record, so that one compiled program makes them all."""


def rolled(tank, commands, key=KEY):
    return rolled_with(tank, commands, key)


@jax.jit
def rolled_with(tank, commands, key):
    """A key that is left out would be part of another program."""
    return roll(tank, tank.init(key), commands)


def issue(*pieces):
    """One command a tick, of (angle, velocity, ticks); the last one is held to the end."""
    columns = [
        np.concatenate([np.full(p[2], p[i], np.float32) for p in pieces])[:TICKS] for i in (0, 1)
    ]
    return Command(*(jnp.asarray(np.pad(x, (0, TICKS - x.size), mode="edge")) for x in columns))


def excitation(logs, ticks, seed=0):
    """The paper's: random commands, each held for 0.2 to 1.5 s."""
    rng = np.random.default_rng(seed)
    found = np.zeros((2, logs, ticks), np.float32)
    for log in range(logs):
        tick = 0
        while tick < ticks:
            for channel, low, high in ((0, -np.pi / 2, np.pi / 2), (1, 1.0, 7.1)):
                found[channel, log, tick:] = rng.uniform(low, high)
            tick += rng.integers(20, 150)
    return Command(*map(jnp.asarray, found))


def beating(centre, amplitude=0.5, velocity=6.0):
    """On the 3 Hz clock."""
    return issue(
        *((centre + amplitude * (-1.0) ** i, velocity, PAPER_CLOCK.ticks[i % 3]) for i in range(30))
    )


def test_a_tank_is_a_plant():
    tank = Tank()
    assert isinstance(tank, Plant)
    assert tank.limits.angle_max == PAPER_LIMITS.angle_max
    assert (tank.limits.velocity_min, tank.limits.velocity_max) == (1.0, 7.1)


def test_holding_a_command_is_issuing_it_every_tick():
    tank = COARSE
    command = Command(jnp.float32(1.0), jnp.float32(2.0))
    state, reading = jax.jit(lambda command: tank.advance(tank.init(KEY), command, 40))(command)
    ticked = rolled(tank, issue((1.0, 2.0, TICKS)))[1]
    for one, other in zip(reading, ticked, strict=True):
        np.testing.assert_allclose(one, other[:40], rtol=1e-4, atol=0.025)
    assert int(state.ticks) == 40
    np.testing.assert_allclose(reading.time, np.arange(1, 41) * TICK_S, rtol=1e-6)


def test_the_fin_ends_up_still_where_it_was_sent_and_makes_no_force():
    reading = rolled(Tank(QUIET), issue((1.0, 2.0, TICKS)))[1]
    assert reading.angle[-1] == pytest.approx(1.0, abs=1e-4)
    assert reading.velocity[-1] == pytest.approx(0.0, abs=1e-4)
    np.testing.assert_allclose(reading.force[-50:], 0.0, atol=0.02)


def test_at_rest_there_is_no_force():
    reading = rolled(Tank(QUIET), issue((0.0, 1.0, TICKS)))[1]
    np.testing.assert_array_equal(reading.force, np.zeros((TICKS, 2)))
    np.testing.assert_array_equal(reading.angle, np.zeros(TICKS))


def test_mirrored_commands_mirror_y_and_leave_x():
    commands = jax.tree.map(lambda x: x[0], excitation(1, TICKS))
    one = rolled(Tank(QUIET), commands)[1]
    other = rolled(Tank(QUIET), commands._replace(angle=-commands.angle))[1]
    np.testing.assert_allclose(other.force, one.force * jnp.array([1.0, -1.0]), atol=1e-3)
    np.testing.assert_allclose(other.angle, -one.angle, atol=1e-6)


def test_noise_differs_between_keys_and_nothing_else_does():
    tank = Tank()
    first, second = (rolled(tank, issue((0.5, 2.0, TICKS)), jax.random.key(i))[1] for i in (1, 2))
    np.testing.assert_array_equal(first.angle, second.angle)
    assert 0 < np.abs(first.force - second.force).max() < 1.0


def test_a_rigid_fin_at_constant_speed_feels_drag_across_and_its_own_centrifugal_force_along():
    config = TankConfig(fin=FinConfig(youngs_modulus_pa=1e10), water=STILL, sensor=IDEAL)
    rate = 2.0
    reading = rolled(Tank(config), issue((-1.5, 3.0, 200), (1.5, rate, 110)))[1]
    tick = 290
    angle = float(reading.angle[tick]) - rate * TICK_S / 2
    force = np.asarray(reading.force[tick])
    across = force @ [np.sin(angle), np.cos(angle)]
    along = force @ [-np.cos(angle), np.sin(angle)]
    fin = config.fin
    length = config.fin.length_m
    middles = (np.arange(10_000) + 0.5) / 10_000 * length
    speed = rate * middles
    span = fin.span(middles)
    drag = 0.5 * 998.2 * config.water.drag_coefficient * (span * speed**2).mean() * length
    mass = fin.density_kg_m3 * span * fin.thickness(middles)
    centrifugal = (mass * rate * speed).mean() * length
    assert across == pytest.approx(-drag, rel=0.01)
    assert along == pytest.approx(centrifugal, rel=0.02)


def test_in_vacuum_the_force_summed_twice_is_the_way_of_the_centre_of_mass():
    vacuum = WaterConfig(added_mass_coefficient=0.0, drag_coefficient=0.0, friction_coefficient=0.0)
    config = TankConfig(water=vacuum, drive=DriveConfig(lag_s=0.05), sensor=IDEAL)
    tank = Tank(config)
    force = np.asarray(rolled(tank, issue((1.0, 2.0, 1000)))[1].force, float)
    np.testing.assert_allclose(force.sum(0) * TICK_S, 0.0, atol=2e-4)
    inertia = tank.fin.inertia
    starts = tank.fin.plate_length * np.arange(config.fin.plates)
    static = float((inertia.first + inertia.zeroth * starts).sum())
    way = static * (np.array([-np.cos(1.0), np.sin(1.0)]) - np.array([-1.0, 0.0]))
    impulses = np.cumsum(force, axis=0) * TICK_S
    summed = (impulses.sum(0) - impulses[-1] / 2) * TICK_S
    np.testing.assert_allclose(-summed, way, rtol=0.01)


def of_points(tank, fin, stream):
    """Momentum of the fin and its water, and the ends of the plates, by summing points [N s]."""
    angles = fin.angles
    rates = fin.rates
    length = float(tank.fin.plate_length)
    points = 4
    nodes, weights = np.polynomial.legendre.leggauss(points)
    normals = np.stack([np.sin(angles), np.cos(angles)], -1)
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum(length * normals * rates[:, None], axis=0)])
    total = np.zeros(2)
    own_moments = (np.asarray(moment) for moment in tank.fin.inertia[:2])
    for plate, (zeroth, first, added) in enumerate(
        zip(*own_moments, tank.water.inertia.zeroth, strict=True)
    ):
        # A linear density with the plate's zeroth and first moments.
        slope = 12 * (first - zeroth * length / 2) / length**3
        for node, weight in zip(nodes, weights, strict=True):
            s = (node + 1) / 2 * length
            velocity = ends[plate] + s * normals[plate] * rates[plate]
            own = (zeroth / length + slope * (s - length / 2)) * velocity
            water = added / length * ((velocity - stream) @ normals[plate]) * normals[plate]
            total += weight / 2 * length * (own + water)
    return total


def test_at_every_step_the_sensor_feels_the_loads_less_the_change_of_momentum():
    with jax.enable_x64(True):
        tank = Tank(TankConfig(drive=DriveConfig(dead_time_s=0.0), sensor=IDEAL, steps_per_tick=1))

        def tick(state, command):
            """What moves before and after it, what is read, and the loads, which no reading
            shows."""
            planned = tank.drive.plan(state.drive, command, TICK_S)
            shaft = tank.drive.shaft(state.drive, planned, TICK_S)
            _, _, loads = tank.fin.step(state.fin, shaft, tank.water.around(state.flow), TICK_S)
            after, reading = tank.advance(state, command, 1)
            return after, (
                (state.fin, state.flow.stream),
                (after.fin, state.flow.stream),
                reading.force[0],
                loads,
            )

        commands = Command(jnp.repeat(jnp.asarray([1.0, -1.0]), 30), jnp.full(60, 5.0))
        ticks = jax.jit(lambda commands: jax.lax.scan(tick, tank.init(KEY), commands)[1])(commands)
        before, after, force, loads = jax.tree.map(np.asarray, ticks)
        for index in range(60):
            momenta = [
                of_points(tank, *jax.tree.map(lambda x, i=index: x[i], moving))
                for moving in (before, after)
            ]
            rate = (momenta[1] - momenta[0]) / TICK_S
            np.testing.assert_allclose(force[index], loads[index] - rate, atol=1e-9)
        assert np.abs(force).max() > 0.1


@pytest.mark.parametrize(
    ("centre", "x", "y"), [(0.0, (1.5, 4.0), (-0.5, 0.5)), (0.75, (0.5, 4.0), (-4.0, -1.0))]
)
def test_beating_makes_thrust_away_from_the_fin(centre, x, y):
    mean = rolled(Tank(QUIET), beating(centre))[1].force[200:].mean(0)
    assert x[0] < mean[0] < x[1]
    assert y[0] < mean[1] < y[1]


def test_a_stroke_is_a_pulse_of_five_to_fifteen_newtons_for_a_fraction_of_a_second():
    for end in (0.75, 1.0):
        reading = rolled(Tank(QUIET), issue((-end, 6.5, 200), (end, 6.5, 150)))[1]
        size = np.linalg.norm(np.asarray(reading.force[200:]), axis=-1)
        assert 5.0 < size.max() < 15.0
        assert 0.2 < TICK_S * (size > size.max() / 2).sum() < 0.45


@pytest.mark.slow
def test_some_gait_of_six_actions_holds_each_reference_force():
    tank = Tank(QUIET)
    rng = np.random.default_rng(0)
    gaits = 500
    centre, amplitude, velocity = (
        rng.uniform(low, high, (gaits, 1)) for low, high in ((-1, 1), (0.1, 1), (3, 7.1))
    )
    angle = np.clip(centre + amplitude * (-1.0) ** np.arange(6), -1.57, 1.57)
    actions = Command(*(jnp.asarray(x, jnp.float32) for x in (angle, np.tile(velocity, 6))))

    def mean(gait):
        repeated = jax.tree.map(lambda x: jnp.tile(x, 3), gait)
        return hold(tank, tank.init(KEY), repeated)[1].force[400:].mean(0)

    means = np.asarray(jax.jit(jax.vmap(mean))(actions))
    for reference in ((1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1)):
        assert np.linalg.norm(means - reference, axis=-1).min() < 0.25, reference


def test_commands_beyond_the_limits_are_refused_before_anything_moves():
    tank = COARSE
    with pytest.raises(CommandError, match=r"angle = 2 rad: .* -1\.5708 to 1\.5708 rad"):
        roll(tank, tank.init(KEY), Command(jnp.array([0.0, 2.0]), jnp.array([1.0, 1.0])))
    with pytest.raises(CommandError, match=r"velocity = 0\.5 rad/s: .* 1 to 7\.1 rad/s"):
        tank.advance(tank.init(KEY), Command(jnp.float32(0.0), jnp.float32(0.5)), 3)
    with pytest.raises(CommandError, match="angle = nan"):
        hold(tank, tank.init(KEY), Command(jnp.array([np.nan]), jnp.array([2.0])))


TANKS = {
    "default": Tank(),
    "loose": Tank(
        TankConfig(
            drive=DriveConfig(backlash_rad=0.05, torque_limit_nm=0.3, dead_time_s=0.025),
            water=WaterConfig(drag_exponent=1 / 3, stream_decay_s=5.0, stream_mass_kg=0.2),
        )
    ),
    "limp": Tank(TankConfig(fin=FinConfig(youngs_modulus_pa=1e3, damping_s=0.0))),
    "stiff": Tank(TankConfig(fin=FinConfig(youngs_modulus_pa=1e12), drive=DriveConfig(lag_s=0.0))),
}
COMMAND = st.tuples(st.floats(-1.57, 1.57), st.floats(1.0, 7.1), st.sampled_from([1, 3, 33]))


@pytest.mark.parametrize("name", TANKS)
@settings(max_examples=8, deadline=None)
@given(st.lists(COMMAND, min_size=4, max_size=20))
def test_no_command_makes_a_reading_that_is_not_a_number(name, pieces):
    state, reading = rolled(TANKS[name], issue(*pieces, *pieces, *pieces))
    assert np.isfinite(reading.force).all()
    assert np.abs(np.asarray(state.fin.angles)).max() < 10.0


def test_the_force_converges_as_the_square_of_the_step_and_the_default_step_is_fine():
    fin = FinConfig(plates=2)
    with jax.enable_x64(True):
        commands = jax.tree.map(lambda x: jnp.asarray(x[0], float), excitation(1, TICKS))

        def force(steps):
            tank = Tank(TankConfig(fin=fin, sensor=IDEAL, steps_per_tick=steps))
            return np.asarray(rolled(tank, commands)[1].force)

        best = force(40)
        spread = best.std()
        errors = {steps: np.sqrt(np.mean((force(steps) - best) ** 2)) / spread for steps in (2, 4)}
    assert errors[QUIET.steps_per_tick] < 0.005
    assert np.log2(errors[2] / errors[4]) == pytest.approx(2.0, abs=0.3)


@pytest.mark.slow
def test_the_force_converges_at_least_as_the_square_of_the_number_of_plates():
    commands = jax.tree.map(lambda x: x[0], excitation(1, TICKS))

    def force(plates, **fin):
        config = TankConfig(fin=FinConfig(plates=plates, **fin), sensor=IDEAL)
        return np.asarray(rolled(Tank(config), commands)[1].force)

    def error(plates, best, **fin):
        return np.sqrt(np.mean((force(plates, **fin) - best) ** 2)) / best.std()

    assert error(QUIET.fin.plates, force(16)) < 0.01
    # The edge of the bracket stands on a joint or beside it, so the order shows without it.
    smooth = {"root_length_m": 0.0}
    best = force(16, **smooth)
    assert 1.8 < np.log2(error(4, best, **smooth) / error(8, best, **smooth)) < 3.5


def test_the_gradient_through_a_second_agrees_with_finite_differences():
    with jax.enable_x64(True):
        config = TankConfig(fin=FinConfig(plates=2), sensor=SensorConfig(resolution_n=0.0))
        tank = Tank(config)

        def effort(tank, angles):
            commands = Command(jnp.repeat(angles, 33), jnp.full(99, 2.5))
            force = roll(tank, tank.init(KEY), commands)[1].force
            return (force * jnp.array([1.0, 0.5])).mean() + 0.01 * (force**2).mean()

        angles = jnp.array([0.6, -0.4, 0.5])
        step = 1e-5
        value = jax.jit(jax.value_and_grad(effort, argnums=(0, 1)))
        by_tank, by_angles = value(tank, angles)[1]
        aside = [
            (value(tank, angles + step * e)[0] - value(tank, angles - step * e)[0]) / (2 * step)
            for e in np.eye(3)
        ]
        np.testing.assert_allclose(by_angles, aside, rtol=1e-3, atol=1e-5)
        assert np.abs(by_angles).max() > 1e-3
        scaled = {c: value(with_parameters(tank, stiffness=c), angles)[0] for c in (0.9999, 1.0001)}
        along = (
            by_tank.fin.stiffness * tank.fin.stiffness + by_tank.fin.damping * tank.fin.damping
        ).sum()
        assert float(along) == pytest.approx(
            float(scaled[1.0001] - scaled[0.9999]) / 2e-4, rel=1e-3
        )
        # At rest every root and every absolute value stands at zero.
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(value(tank, jnp.zeros(3))))
