import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.quantities import Command, Reading
from softfin.tank.calibration.config import RecordingConfig
from softfin.tank.calibration.model import RecordingArrays

COMMAND = Command(jnp.asarray([-1.0, 0.5]), jnp.asarray([1.0, 3.0]))
READING = Reading(jnp.arange(2.0), jnp.asarray([0.0, 1.0]), jnp.asarray([2.0, 0.0]), jnp.ones((2, 2)))


def test_by_default_a_log_means_what_it_says():
    recording = RecordingArrays.build(RecordingConfig())
    assert all((ours == theirs).all() for ours, theirs in zip(recording.issued(COMMAND), COMMAND, strict=True))
    assert (recording.written(READING).force == READING.force).all()


def test_angles_are_scaled_and_shifted_velocities_scaled_and_limited_forces_shifted():
    config = RecordingConfig(
        angle_gain=0.8,
        angle_offset_rad=0.1,
        velocity_factor=2.0,
        velocity_limit_rad_s=5.0,
        reading_gain=0.5,
        reading_offset_rad=-0.1,
        force_x_n=0.5,
        force_y_n=-1.0,
    )
    issued = RecordingArrays.build(config).issued(COMMAND)
    np.testing.assert_allclose(issued.angle, [-0.7, 0.5], rtol=1e-6)
    np.testing.assert_allclose(issued.velocity, [2.0, 5.0], rtol=1e-6)
    written = RecordingArrays.build(config).written(READING)
    np.testing.assert_allclose(written.angle, [-0.1, 0.4], rtol=1e-6)
    np.testing.assert_allclose(written.velocity, [1.0, 0.0])
    np.testing.assert_allclose(written.force, [[1.5, 0.0]] * 2)


def test_a_velocity_that_would_not_move_the_drive_is_refused():
    with pytest.raises(ValueError, match="velocity_factor"):
        RecordingConfig(velocity_factor=0.0)
