import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.quantities import Command
from softfin.tank.calibration.report import calibration_figure, means, peaks
from softfin.tank.calibration.segments import Segments

COMMAND = np.repeat([[0.5, -0.5, 1.0, 0.0], [1.0, -1.0, 0.3, -0.3]], 100, axis=1).astype(np.float32)


def segments(readings, warm_up):
    return Segments(Command(jnp.asarray(COMMAND), jnp.ones(COMMAND.shape)), jnp.asarray(readings), warm_up)


def noise(seed=0):
    return np.random.default_rng(seed).normal(size=(2, 400, 3)).astype(np.float32)


def test_peaks_are_those_of_each_whole_stroke_behind_the_warm_up():
    readings = np.zeros((2, 400, 3), np.float32)
    readings[0, 50, 1] = 100.0  # in the warm-up
    readings[0, 230, 1:] = (3.0, -4.0)
    readings[1, 399, 1] = -7.0
    # Commands change at 100, 200 and 300; the stroke that the warm-up ends in is not whole.
    np.testing.assert_allclose(peaks(segments(readings, 150), readings), [5.0, 0.0, 0.0, 7.0])


@pytest.mark.parametrize("beating", [True, False])
def test_the_figure_shows_both_sides_with_units(beating):
    test = segments(noise(), 150)
    modelled = noise() + np.float32(0.5)
    figure = calibration_figure(test, modelled, means(test, modelled) if beating else None)
    axes = figure.get_axes()
    labels = {axis.get_ylabel() for axis in axes} | {axis.get_xlabel() for axis in axes}
    assert {"angle [rad]", "force x [N]", "force y [N]", "time [s]", "mean force [N]"} <= labels
    assert axes[3].get_title(loc="left").startswith("Mean force: beating" if beating else "Mean force: means over 2 s")
    for axis in axes[:3]:
        measured, modelled = axis.get_lines()[-2:]
        np.testing.assert_allclose(modelled.get_ydata() - measured.get_ydata(), 0.5, atol=1e-6)
        assert "R²" in axis.get_title(loc="right")
