import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.colors import to_rgb

from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, score_controller
from softfin.evaluation.figures import experiments_figure
from softfin.evaluation.report import prediction_figure
from softfin.learning.controllers import learning_figure
from softfin.storage import figures as style
from softfin.storage.figures import save_figure
from tests.plants import AnalyticFin, Flapper


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return score_controller(Flapper(), AnalyticFin(), EvaluateConfig(seconds=11, seeds=2))


def lines(axes) -> dict:
    return {line.get_label(): line for line in axes.get_lines()}


def test_each_reference_has_its_trajectory_and_both_forces(evaluation):
    axes = experiments_figure(evaluation.recording).get_axes()
    assert len(axes) == 3 * 6
    for index, (polar, above, below) in enumerate(
        zip(axes[::3], axes[1::3], axes[2::3], strict=True)
    ):
        radius = polar.get_lines()[0].get_ydata()
        np.testing.assert_allclose(radius, np.arange(1, 501) / 100)
        np.testing.assert_array_equal(
            polar.get_lines()[0].get_xdata(), evaluation.recording.reading.angle[index, 0, :500]
        )
        for axis, panel in enumerate((above, below)):
            shown = lines(panel)
            force = evaluation.recording.reading.force[index, 0, :1000, axis]
            np.testing.assert_array_equal(shown["force"].get_ydata(), force)
            average = shown["moving average over 2 s"]
            assert average.get_linestyle() == "--"
            np.testing.assert_allclose(average.get_xdata()[[0, -1]], [2.0, 10.0])
            assert average.get_ydata()[0] == pytest.approx(force[:200].mean(), abs=1e-5)
            assert set(shown["reference"].get_ydata()) == {
                evaluation.recording.reference[index, axis]
            }
            assert panel.get_ylabel() == f"force {'xy'[axis]} [N]"
        assert below.get_xlabel() == "time [s]"


def test_a_fin_at_positive_angles_is_drawn_up_and_to_the_left(evaluation):
    polar = experiments_figure(evaluation.recording).get_axes()[0]
    x, y = polar.transData.transform([[0.5, 1.0]])[0] - polar.transData.transform([[0.0, 0.0]])[0]
    assert x < 0 < y


def test_an_angle_beyond_90_degrees_is_still_drawn():
    far = score_controller(
        Flapper(angle=1.9),
        AnalyticFin(lag_s=0.02),
        EvaluateConfig(references=[(1, 1)], seconds=3, seeds=1),
    )
    polar = experiments_figure(far.recording).get_axes()[0]
    assert np.degrees(np.abs(far.recording.reading.angle).max()) <= polar.get_thetamax()


def test_a_learning_curve_shows_the_errors_at_their_steps():
    (line,) = learning_figure(([0, 100, 200], [3, 2, 1])).get_axes()[0].get_lines()
    np.testing.assert_array_equal(line.get_xdata(), [0, 100, 200])
    np.testing.assert_array_equal(line.get_ydata(), [3, 2, 1])


def test_a_prediction_is_laid_over_its_measurement():
    force = np.random.default_rng(0).normal(size=(50, 2))
    axes = prediction_figure(force, {"free-running": force + 1}, start_s=3.0).get_axes()
    for index, panel in enumerate(axes):
        np.testing.assert_array_equal(lines(panel)["measured"].get_ydata(), force[:, index])
        np.testing.assert_array_equal(lines(panel)["free-running"].get_ydata(), force[:, index] + 1)
        assert lines(panel)["measured"].get_xdata()[0] == 3.0


def test_colours_differ_in_grey_too():
    def lightness(colour):
        return np.dot(to_rgb(colour), [0.299, 0.587, 0.114])

    shades = sorted(map(lightness, (style.BLACK, style.BLUE, style.ORANGE, "#FFFFFF")))
    assert min(np.diff(shades)) > 0.2


def test_drawing_leaves_no_global_state(evaluation, tmp_path):
    before = dict(rcParams)
    save_figure(experiments_figure(evaluation.recording), tmp_path / "figure.png")
    assert dict(rcParams) == before


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_the_same_figure_gives_the_same_file(tmp_path, suffix):
    # Not of polar axes: Matplotlib names their clip paths by addresses in memory.
    for name in "ab":
        figure = learning_figure(([0, 1], [0, 1]))
        save_figure(figure, tmp_path / f"{name}.{suffix}")
    one, other = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in "ab")
    assert one == other
    assert one.startswith({"svg": b"<?xml", "png": b"\x89PNG"}[suffix])
