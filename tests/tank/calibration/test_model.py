import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Reading
from softfin.tank import TankConfig
from softfin.tank.calibration.config import RecordingConfig
from softfin.tank.calibration.model import Model

COMMAND = Command(jnp.asarray([-1.0, 0.5]), jnp.asarray([1.0, 3.0]))


class Echo:
    """Its shaft stands where it is commanded to, and its force is the commanded velocity, either
    way."""

    limits = PAPER_LIMITS._replace(velocity_max=9.0)

    def init(self, key):
        return jnp.zeros(())

    def advance(self, state, command, ticks):
        def tick(time, _):
            time = time + TICK_S
            return time, Reading(
                time, command.angle, jnp.zeros(()), jnp.stack([command.velocity, -command.velocity])
            )

        return jax.lax.scan(tick, state, length=ticks)


def read(config):
    return Model(Echo(), Model.build(TankConfig(), config).recording).read(COMMAND)


def test_by_default_a_log_means_what_it_says():
    np.testing.assert_array_equal(read(RecordingConfig()), [[-1.0, 1.0, -1.0], [0.5, 3.0, -3.0]])


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
    np.testing.assert_allclose(read(config), [[-0.45, 2.5, -3.0], [0.15, 5.5, -6.0]], rtol=1e-6)
