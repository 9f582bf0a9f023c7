import itertools

import jax
import numpy as np
import PIL.Image
import pytest

from softfin.evaluation.view.files import shown_ticks, write_gif, write_png
from softfin.evaluation.view.footage import choose_scale
from softfin.evaluation.view.picture import BLUE, FIN, Picture
from tests.evaluation.view.fins import BendingFin, OffsetSensor, beating

DPI = 50


@pytest.fixture(scope="module")
def picture():
    return Picture(beating(BendingFin(), 220, reference=(2.0, -1.0)), "a fin", DPI)


def rgb(colour):
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def where(image, colour):
    """Pixels (row, column) of about a colour."""
    return np.argwhere(np.abs(image.astype(int) - rgb(colour)).max(axis=2) < 24)


def test_a_frame_depends_on_its_tick_alone(picture):
    first = picture.frame(10)
    picture.frame(215)
    np.testing.assert_array_equal(picture.frame(10), first)
    assert first.shape == (260, 480, 3)


def test_a_footage_that_grows_is_drawn_up_to_now_with_nothing_ahead():
    whole = beating(BendingFin(), 220, reference=(2.0, -1.0))

    def first(ticks):
        cut = jax.tree.map(
            lambda x: x[:ticks],
            whole._replace(shape_known=None, thickness=None, average=None, length_m=None),
        )
        average = whole.average[: max(ticks - 199, 0)]
        return cut._replace(
            length_m=whole.length_m, shape_known=True, thickness=whole.thickness, average=average
        )

    growing = Picture(first(1), "a fin", DPI, growing=(choose_scale(whole), 2.2))
    known = Picture(whole, "a fin", DPI)
    for ticks in (1, 50, 210):
        growing.footage = first(ticks)
        np.testing.assert_array_equal(growing.frame(-1)[:, :240], known.frame(ticks - 1)[:, :240])
    np.testing.assert_allclose(growing._moving[-1][0].get_ydata(), whole.average[:11, 1])
    assert (growing.frame(49)[:, 300:] != known.frame(49)[:, 300:]).any()


def test_the_fin_is_drawn_where_its_shape_is_to_the_left_of_the_shaft(picture):
    angle = picture.footage.reading.angle
    axes = picture.figure.get_axes()[0]
    for tick in (int(angle.argmax()), int(angle.argmin())):
        image = picture.frame(tick)
        x, y = picture.footage.shape[tick, 4]
        assert x < 0
        assert np.sign(y) == np.sign(angle[tick])
        seen = [axes.transData.transform(place) for place in ((x, y), (x, -y))]
        fin, water = (image[round(image.shape[0] - row), round(column)] for column, row in seen)
        np.testing.assert_allclose(fin, rgb(FIN), atol=8)
        assert water.min() > 200


def test_the_arrow_of_the_force_is_as_long_as_its_scale_says(picture):
    force = picture.footage.reading.force
    tick = int(np.abs(force[:, 0]).argmax())
    scale = choose_scale(picture.footage)
    axes = picture.figure.get_axes()[0]
    per_metre = axes.bbox.width / np.ptp(axes.get_xlim())
    assert axes.bbox.height / np.ptp(axes.get_ylim()) == pytest.approx(per_metre, rel=1e-6)
    picture.frame(tick)
    drawn = picture.arrows["force"].get_xy()
    np.testing.assert_allclose(drawn[3], force[tick] * scale.metres_per_newton, rtol=1e-5)


def texts_of(picture):
    figure = picture.figure
    texts = [text.get_text() for axes in figure.get_axes() for text in axes.texts]
    texts += [text.get_text() for text in figure.get_axes()[1].get_legend().get_texts()]
    return texts + [axes.get_ylabel() for axes in figure.get_axes()]


def test_a_picture_draws_the_true_force_where_it_is_known_and_says_so(picture):
    assert "measured" in texts_of(picture)
    assert not any("true" in text for text in texts_of(picture))
    footage = beating(OffsetSensor(), 220)
    known = Picture(footage, "a fin", DPI)
    assert {"angle, true force", "true force x [N]", "true force y [N]"} <= set(texts_of(known))
    assert f"true force {known.scale.key_n:g} N" in texts_of(known)
    known.frame(150)
    drawn = known.arrows["force"].get_xy()
    np.testing.assert_allclose(
        drawn[3], footage.true_force[150] * known.scale.metres_per_newton, rtol=1e-5
    )


def test_reference_and_mean_share_a_longer_scale_and_the_reference_moves_with_its_step():
    footage = beating(BendingFin(), 220, reference=(2.0, -1.0))
    footage.reference[100:] = (1.0, 1.0)
    # Peaks far above the mean, as a fin with much added mass makes them.
    footage = footage._replace(reading=footage.reading._replace(force=10 * footage.reading.force))
    picture = Picture(footage, "a fin", DPI)
    scale = picture.scale
    greatest = max(np.hypot(2, 1), np.hypot(*footage.average.T).max())
    assert scale.metres_per_mean_newton * greatest == pytest.approx(0.4 * scale.length_m, rel=1e-3)
    for tick, asked in ((99, (2.0, -1.0)), (100, (1.0, 1.0))):
        picture.frame(tick)
        drawn = picture.arrows["asked"].get_xy()
        np.testing.assert_allclose(
            drawn[3], np.multiply(asked, scale.metres_per_mean_newton), rtol=1e-5
        )
    picture.frame(219)
    np.testing.assert_allclose(
        picture.arrows["mean"].get_xy()[3],
        footage.average[-1] * scale.metres_per_mean_newton,
        rtol=1e-5,
    )


def test_without_a_reference_force_and_mean_have_one_scale():
    scale = choose_scale(beating(BendingFin(), 220))
    assert scale.metres_per_mean_newton == scale.metres_per_newton


def test_every_shape_and_arrow_is_within_what_is_seen(picture):
    scale = choose_scale(picture.footage)
    footage = picture.footage
    arrows = [
        footage.reading.force * scale.metres_per_newton,
        footage.average * scale.metres_per_mean_newton,
    ]
    for points in (
        footage.shape.reshape(-1, 2),
        *arrows,
        footage.reference * scale.metres_per_mean_newton,
    ):
        assert scale.x[0] < points[:, 0].min()
        assert points[:, 0].max() < scale.x[1]
        assert scale.y[0] < points[:, 1].min()
        assert points[:, 1].max() < scale.y[1]


def test_a_gif_has_its_frames_in_real_time_and_moves(picture, tmp_path):
    done = []
    write_gif(tmp_path / "fin.gif", picture, 25, done.append)
    with PIL.Image.open(tmp_path / "fin.gif") as gif:
        assert gif.n_frames == 55
        assert gif.info["loop"] == 0
        shown = []
        for k in (0, 10, 20, 54):
            gif.seek(k)
            assert gif.info["duration"] == 40
            shown.append(np.array(gif.convert("RGB")))
        assert tuple(shown[-1][0, 0]) == (255, 255, 255)
    assert all(len(where(before, FIN)) for before in shown)
    left = [image[:, : image.shape[1] // 2] for image in shown]
    assert all(
        (before != after).any(axis=2).sum() > 100 for before, after in itertools.pairwise(left)
    )
    # What a film shows last is the state at its end, in nearly its colours.
    assert np.abs(shown[-1].astype(int) - picture.frame(219)).mean() < 3
    assert done[-1] == 1.0
    assert [path.name for path in tmp_path.iterdir()] == ["fin.gif"]


def test_a_png_is_the_last_frame(picture, tmp_path):
    write_png(tmp_path / "fin.png", picture)
    with PIL.Image.open(tmp_path / "fin.png") as image:
        assert np.abs(np.array(image.convert("RGB")).astype(int) - picture.frame(219)).mean() < 3


@pytest.mark.parametrize("rate", [10, 20, 25, 50])
def test_the_last_tick_is_always_shown(rate):
    for ticks in (10, 99, 100, 101):
        shown = shown_ticks(ticks, rate)
        assert shown[-1] == ticks - 1
        assert len(shown) == -(-ticks * rate // 100)


def test_the_arrows_colour_is_that_of_the_force_traces(picture):
    image = picture.frame(219)
    columns = where(image, BLUE)[:, 1]
    assert (columns < 240).any()
    assert (columns > 240).any()
