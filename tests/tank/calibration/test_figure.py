import jax.numpy as jnp
import numpy as np

from softfin.core.quantities import Command
from softfin.tank.calibration.calibrate import calibration_figure, scores
from softfin.tank.calibration.model import Segments


def test_the_figure_shows_both_sides_with_units():
    command = Command(jnp.zeros((2, 400)), jnp.ones((2, 400)))
    readings = np.random.default_rng(0).normal(size=(2, 400, 3)).astype(np.float32)
    test = Segments(command, jnp.asarray(readings), 150)
    modelled = readings + np.float32(0.5)
    axes = calibration_figure(test, modelled, scores(modelled, test)).get_axes()
    labels = {axis.get_ylabel() for axis in axes} | {axis.get_xlabel() for axis in axes}
    assert {
        "angle [rad]",
        "force x [N]",
        "force y [N]",
        "time [s]",
        "measured [N]",
        "tank [N]",
    } <= labels
    for axis in axes[:3]:
        measured, ours = axis.get_lines()[-2:]
        np.testing.assert_allclose(ours.get_ydata() - measured.get_ydata(), 0.5, atol=1e-6)
        assert "R²" in axis.get_title(loc="right")
    for index, line in ((1, axes[3].get_lines()[1]), (2, axes[3].get_lines()[2])):
        means = readings[:, 150:350, index].mean(axis=1)
        np.testing.assert_allclose(
            line.get_xydata(), np.stack([means, means + 0.5], axis=1), rtol=1e-5
        )
