"""A fin on a mount that moves: towed, speeded up, in a stream and turned."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S, Command
from softfin.tank import Tank, TankConfig
from softfin.tank.drive import DriveConfig
from softfin.tank.fin import FinConfig, Mount
from softfin.tank.hydrodynamics import WaterConfig

RIGID = FinConfig(youngs_modulus_pa=2e10, damping_s=1e-3)
STILL = WaterConfig(stream_decay_s=0)
SPAN = RIGID.span_m
LENGTH = RIGID.length_m
DENSITY = 998.2
ADDED = DENSITY * np.pi / 4 * SPAN**2
"""Added mass per length [kg/m]."""


def mount(velocity: Any = (0, 0), acceleration: Any = (0, 0), turn: float = 0) -> Mount:
    return Mount(*(jnp.asarray(each, jnp.float32) for each in (velocity, acceleration, turn)))


def tank(**water: float) -> Tank:
    return Tank(TankConfig(fin=RIGID, water=STILL.model_copy(update=water)))


def loads(
    tank: Tank, motion: Mount, ticks: int, command: Command | None = None
) -> Float[np.ndarray, "ticks 3"]:
    """Force (x, y) [N] and torque [N m] of each tick, from rest at angle 0."""
    command = command or Command(jnp.float32(0), jnp.float32(1))

    def tick(state: object, motion: Mount) -> tuple[object, Float[Array, "3"]]:
        state, _, load = tank.tick(state, command, motion)
        return state, jnp.append(load.force, load.torque)

    held = jax.tree.map(lambda x: jnp.broadcast_to(x, (ticks, *x.shape)), motion)
    run = jax.jit(lambda held: jax.lax.scan(tick, tank.init(jax.random.key(0)), held)[1])
    return np.asarray(run(held), float)


@pytest.mark.parametrize("speed", [0.05, -0.2])
def test_a_towed_rigid_plate_has_the_drag_of_its_coefficient(speed: float) -> None:
    found = loads(tank(), mount((0, speed)), 100)[-1]
    drag = -0.5 * DENSITY * STILL.drag_coefficient * SPAN * LENGTH * speed * abs(speed)
    assert found[1] == pytest.approx(drag, rel=1e-3)
    # At angle 0 the fin points along -x: drag in y turns it towards smaller angles where it is
    # dragged towards -y.
    assert found[2] == pytest.approx(drag * LENGTH / 2, rel=2e-3)


def test_a_mount_that_speeds_up_carries_fin_and_added_mass() -> None:
    still = tank(drag_coefficient=0, friction_coefficient=0)
    own = RIGID.density_kg_m3 * SPAN * RIGID.root_thickness_m * LENGTH
    found = loads(still, mount(acceleration=(0.5, 0.3)), 60)[20:].mean(axis=0)
    assert found[0] == pytest.approx(-0.5 * own, rel=1e-3)
    assert found[1] == pytest.approx(-0.3 * (own + ADDED * LENGTH), rel=1e-3)


@pytest.mark.parametrize("slip", [0.0, 0.5, 1.0, 1.3])
def test_the_thrust_of_a_pitching_plate_in_a_stream_is_lighthill_s(slip: float) -> None:
    # Lighthill 1960: mean thrust m/2 (h_t^2 - U^2 h_x^2) at the trailing edge, 0 where U is L times
    # the frequency.
    frequency = 2 * np.pi
    amplitude = 0.05
    rate = LENGTH * 2 * np.pi
    strong = {"acceleration_rad_s2": 4000, "stiffness_nm_rad": 3000, "torque_limit_nm": 1e4}
    drive = DriveConfig(dead_time_s=0, fastest_rad_s=50, **strong)
    water = STILL.model_copy(update={"drag_coefficient": 0.0, "friction_coefficient": 0.0})
    swung = Tank(TankConfig(fin=RIGID, drive=drive, water=water, steps_per_tick=8))
    moved = mount((slip * rate, 0))
    targets = amplitude * np.sin(frequency * TICK_S * np.arange(401))
    # At this velocity the profile arrives at the end of the tick, and does not stop within it.
    commands = Command(
        *(jnp.asarray(x, jnp.float32) for x in (targets[1:], np.abs(np.diff(targets)) / TICK_S))
    )

    def tick(
        state: object, command: Command
    ) -> tuple[object, tuple[Float[Array, "2"], Float[Array, ""]]]:
        state, reading, load = swung.tick(state, command, moved)
        return state, (load.force, reading.angle)

    run = jax.jit(lambda commands: jax.lax.scan(tick, swung.init(jax.random.key(0)), commands)[1])
    force, angle = (np.asarray(each, float)[200:] for each in run(commands))
    swing = np.sqrt(2 * np.mean(angle**2))
    thrust = ADDED / 4 * (1 - slip**2) * (rate * swing) ** 2
    assert force[:, 0].mean() == pytest.approx(thrust, abs=0.03 * ADDED / 4 * (rate * swing) ** 2)


@pytest.mark.parametrize("kind", [RIGID, FinConfig()])
def test_turning_the_mount_is_turning_the_shaft(kind: FinConfig) -> None:
    speed = 1.5
    ticks = 150
    drive = DriveConfig(
        dead_time_s=0, acceleration_rad_s2=1e4, stiffness_nm_rad=3000, fastest_rad_s=10
    )
    turned = Tank(TankConfig(fin=kind, drive=drive, water=STILL))
    on_shaft = loads(turned, mount(), ticks, Command(jnp.float32(20), jnp.float32(speed)))
    on_mount = loads(turned, mount(turn=speed), ticks)
    # A positive angle turns from -x to +y; forces of the second case are in axes that have turned
    # so.
    angle = -speed * TICK_S * (np.arange(ticks) + 0.5)
    cos = np.cos(angle)
    sin = np.sin(angle)
    x = on_mount[:, 0]
    y = on_mount[:, 1]
    there = np.stack([cos * x - sin * y, sin * x + cos * y, on_mount[:, 2]], axis=1)
    late = slice(100, None)
    np.testing.assert_allclose(
        there[late], on_shaft[late], atol=0.02 * np.abs(on_shaft[late]).max()
    )


def test_a_mount_that_stands_still_changes_nothing() -> None:
    plain = Tank()
    command = Command(jnp.float32(0.8), jnp.float32(2))
    step = partial(plain.tick, plain.init(jax.random.key(0)), command)
    np.testing.assert_allclose(step(mount())[1].force, step()[1].force, atol=1e-6)
