import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import Command
from softfin.tank.calibration.calibrate import calibration_figure, scores
from softfin.tank.calibration.model import Segments


def test_the_figure_shows_both_sides_with_units():
    command = Command(jnp.zeros((2, 400)), jnp.ones((2, 400)))
    readings = np.random.default_rng(0).normal(size=(2, 400, 3)).astype(np.float32)
    test, modelled = Segments(command, jnp.asarray(readings), 150), readings + np.float32(0.5)
    axes = calibration_figure(test, modelled, scores(modelled, test)).get_axes()
    labels = {axis.get_ylabel() for axis in axes} | {axis.get_xlabel() for axis in axes}
    assert {"angle [rad]", "force x [N]", "force y [N]", "time [s]", "mean angle [rad]", "mean force [N]"} <= labels
    for axis in axes[:3]:
        measured, ours = axis.get_lines()[-2:]
        np.testing.assert_allclose(ours.get_ydata() - measured.get_ydata(), 0.5, atol=1e-6)
        assert "R²" in axis.get_title(loc="right")
    measured_x, measured_y, tank_x, _ = (line.get_xydata() for line in axes[3].get_lines()[:4])
    np.testing.assert_allclose(measured_y, readings[:, 150:350].mean(axis=1)[:, [0, 2]], rtol=1e-5)
    np.testing.assert_allclose(tank_x - measured_x, 0.5, rtol=1e-5)
