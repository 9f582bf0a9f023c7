"""Power of a drive, against balances that follow from its definition."""

import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.power import (
    EC_MAX_30,
    Motor,
    drive_power,
    electrical_power,
    motor_current,
    tick_velocity,
)

IDEAL = Motor(2.0, 0.0, 1.0)
"""A motor without losses."""


def test_a_motor_without_losses_takes_what_the_shaft_gives():
    velocity = np.full(5, 3.0)
    torque = np.full((5, 2), 0.4)
    np.testing.assert_allclose(drive_power(torque, velocity, IDEAL), 1.2)


def test_power_flows_back_over_the_shaft_but_not_into_the_supply():
    torque = np.array([[0.5, 0.5], [0.5, 0.5], [-0.2, -0.2], [-0.2, -0.2]])
    power = drive_power(torque, np.full(4, 2.0), IDEAL)
    np.testing.assert_allclose(power, [[1, 1], [1, 1], [-0.4, 0], [-0.4, 0]])


def test_each_part_loses_its_share():
    # 70% of the power of the motor reaches the fin, and the winding adds its heat.
    motor = EC_MAX_30
    current = motor_current(np.array([0.7, 0.7]), np.float64(1.0), motor)
    assert current == pytest.approx(1 / motor.torque_constant_nm_a)
    power = electrical_power(current, np.float64(1.0), motor)
    assert power == pytest.approx(1 + motor.winding_ohm * current**2)
    # A fin that drives the gear passes on 70% of its power.
    driven = motor_current(np.array([0.7, 0.7]), np.float64(-1.0), motor)
    assert driven == pytest.approx(0.49 / motor.torque_constant_nm_a)


def test_a_rotor_at_the_end_of_a_stroke_turns_its_energy_into_heat():
    # The fin has no load; only the motor torque brakes the rotor.
    torque = np.array([[0.0, -1.0]])
    ((mechanical, electrical),) = drive_power(torque, np.array([4.0]))
    assert (mechanical, electrical) == (0, 0)
    # Holding a torque at rest takes power without any on the shaft.
    ((mechanical, electrical),) = drive_power(np.array([[1.0, 1.0]]), np.array([0.0]))
    assert mechanical == 0
    assert electrical > 0


def test_velocities_are_those_within_ticks_and_jax_agrees():
    velocity = np.array([1.0, 3.0, 2.0], np.float32)
    np.testing.assert_allclose(tick_velocity(velocity), [1.0, 2.0, 2.5])
    torque = np.array([[0.1, 0.2], [0.3, -0.4], [-0.5, 0.6]], np.float32)
    own = drive_power(torque, velocity)
    np.testing.assert_allclose(drive_power(jnp.array(torque), jnp.array(velocity)), own, rtol=1e-5)
