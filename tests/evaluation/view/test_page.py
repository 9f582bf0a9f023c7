import importlib.resources
import json
import re

import numpy as np
import pytest

from softfin.evaluation.view.files import SHAPE_UNIT_M, to_dict, write_page
from tests.evaluation.test_report import Page
from tests.evaluation.view.fins import BendingFin, OffsetSensor, beating
from tests.plants import AnalyticFin


@pytest.fixture(scope="module")
def footage():
    return beating(BendingFin(), 230, reference=(2.0, -1.0))


@pytest.fixture(scope="module")
def html(footage, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "fin.html"
    write_page(path, footage, "A fin </script><b>& more")
    return path.read_text()


def data_of(html):
    return json.loads(
        re.search(r'<script type="application/json" id="footage">(.*?)</script>', html, re.S).group(
            1
        )
    )


def test_the_page_fetches_nothing(html):
    page = Page(html)
    assert page.fetched == []
    assert not re.search(r"https?:|@import|url\(|import\s*\(|fetch\(", html)
    assert "link" not in page.tags


def test_the_page_holds_what_was_read(html, footage):
    data = data_of(html)
    np.testing.assert_allclose(data["angle"], footage.reading.angle, atol=1e-4)
    np.testing.assert_allclose(data["force_y"], footage.reading.force[:, 1], atol=1e-3)
    np.testing.assert_allclose(data["mean_x"], footage.average[:, 0], atol=1e-3)
    shape = np.array(data["shape"]).reshape(230, 9, 2) * SHAPE_UNIT_M
    np.testing.assert_allclose(shape, footage.shape, atol=SHAPE_UNIT_M)
    assert data["reference_x"] == [2.0] * 230
    assert data["reference_y"] == [-1.0] * 230


def test_forces_have_two_decimals_or_more_for_a_small_fin(footage):
    assert to_dict(footage)["decimals"] == 2
    force = 0.01 * footage.reading.force
    small = footage._replace(
        reading=footage.reading._replace(force=force),
        average=0.01 * footage.average,
        reference=0.01 * footage.reference,
    )
    data = to_dict(small)
    assert data["decimals"] > 2
    np.testing.assert_allclose(data["force_x"], force[:, 0], atol=10 ** -data["decimals"] / 10)


def test_the_page_draws_the_true_force_where_it_is_known_and_says_which_force_it_is(html, tmp_path):
    assert "the measured force of the fin" in html
    assert data_of(html)["force_known"] is False
    footage = beating(OffsetSensor(), 230)
    write_page(tmp_path / "fin.html", footage, "a fin")
    page = (tmp_path / "fin.html").read_text()
    np.testing.assert_allclose(data_of(page)["force_x"], footage.true_force[:, 0], atol=1e-3)
    assert "the true force of the fin" in page
    assert "measured</th>" not in page
    assert data_of(page)["force_known"] is True


def test_no_text_closes_the_script_or_becomes_an_element(html):
    assert html.count("</script>") == 2
    assert Page(html).tags.count("b") == 0
    assert "<title>A fin &lt;/script&gt;&lt;b&gt;&amp; more</title>" in html


def test_every_control_has_a_name_and_every_element_of_the_script_is_there(html):
    script = importlib.resources.files("softfin.evaluation.view").joinpath("page.js").read_text()
    asked = set(re.findall(r'element\("(\w+)"\)', script))
    assert asked >= {"tank", "traces", "time", "play", "speed"}
    assert asked <= set(Page(html).ids)
    for control in re.findall(r"<(?:input|select|canvas)[^>]*>", html):
        assert "aria-label=" in control


def test_light_dark_and_narrow_screens_are_provided_for(html):
    assert "prefers-color-scheme: dark" in html
    assert "prefers-reduced-motion" in html
    assert 'name="viewport"' in html


def test_the_page_says_whether_the_shape_is_known(html, tmp_path):
    assert "with its computed shape" in html
    write_page(tmp_path / "fin.html", beating(AnalyticFin(), 40), "straight")
    page = (tmp_path / "fin.html").read_text()
    assert "Shape unknown: the fin is drawn as a straight line" in page
    assert "reference_x" not in data_of(page)
    assert data_of(page)["mean_x"] == []


def test_ten_seconds_of_a_fin_of_eight_plates_take_less_than_a_fifth_of_a_megabyte(footage):
    assert len(json.dumps(to_dict(footage), separators=(",", ":"))) / 230 * 1000 < 200_000
