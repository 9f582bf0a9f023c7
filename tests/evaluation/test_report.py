import re
from collections import Counter
from html.parser import HTMLParser

import jax
import numpy as np
import pytest

from softfin.evaluation.evaluate import EvaluateConfig, evaluate
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.figures import experiments_figure
from softfin.evaluation.report import prediction_figure, write_report
from softfin.learning.controllers import learning_figure
from tests.plants import AnalyticFin, Flapper


class Page(HTMLParser):
    """Text, ids, headings and everything that a browser would fetch."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html, self.text, self.ids, self.fetched, self.tags = html, "", [], [], []
        self.feed(html)
        self.words = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "data") and not (value or "").startswith("#"):
                self.fetched.append(value)

    def handle_data(self, data):
        self.text += data + " "


def net(window=100, parameters=113601, rmse=0.0312):
    scores = {"rmse": rmse, "mae": 0.002, "dtw_raw": 9.0, "dtw_rms": 0.4, "dtw_mae": 0.0015}
    return {"window": window, "parameters": parameters, "physical": scores, "scaled": {**scores, "rmse": rmse / 2}}


@pytest.fixture(scope="module")
def evaluation():
    return evaluate(Flapper(), AnalyticFin(noise_n=0.3), EvaluateConfig(seconds=4, seeds=3))


@pytest.fixture(scope="module")
def results(evaluation):
    still = evaluate(Flapper(angle=0.0), AnalyticFin(noise_n=0.3), EvaluateConfig(seconds=4, seeds=3))
    return {
        "title": "A run",
        "plant": "the analytic fin",
        "surrogate": {
            "scores": {
                "posnet": net(),
                "forcenet_measured": net(parameters=129794),
                "forcenet_free_running": net(parameters=129794, rmse=0.777),
            }
        },
        "controllers": {"single": evaluation.summary(), "grid": still.summary()},
        "configuration": {"collect": {"logs": 7}},
        "provenance": {
            "seed": 3,
            "softfin": "0.1.0",
            "created": "2026-01-01",
            "git_commit": None,
            "data_hash": "abc123",
        },
    }


@pytest.fixture(scope="module")
def page(results, evaluation, tmp_path_factory) -> Page:
    path = tmp_path_factory.mktemp("report") / "report.html"
    force = np.random.default_rng(0).normal(size=(100, 2))
    recording = evaluation.recording
    one = jax.tree.map(lambda x: x[:1], (recording.reference, recording.command, recording.reading))
    trajectory = experiments_figure(ExperimentRecording(*one))
    figures = {
        "surrogate": {"Prediction": prediction_figure(force, {"free-running": force})},
        "learning": {"Learning": learning_figure({"single": [([0, 1], [0, 1])]}, "reward")},
        "experiment": {"Single": trajectory, "Single again": trajectory},
    }
    write_report(path, results, figures)
    return Page(path.read_text())


def test_the_page_fetches_nothing(page):
    assert page.fetched == []
    assert not {"script", "link", "img", "iframe", "object"} & set(page.tags)
    assert not re.search(r"@import|url\((?!#)", page.html)


def test_ids_are_unique_over_the_whole_page(page):
    assert [name for name, count in Counter(page.ids).items() if count > 1] == []
    links = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page.html)
    assert {a or b for a, b in links} <= set(page.ids)


def test_every_figure_is_there(page):
    assert page.tags.count("svg") == 5
    for caption in ("Prediction", "Learning", "Single", "Single again", "Errors of Table II by reference"):
        assert caption in page.words


def test_table_one_has_each_net_in_both_units_beside_the_paper(page):
    assert (
        "PosNet, commands to angle 100 113,601 rad 0.0312 0.00200 0.00150 0.0156 0.00200 0.00150 0.03 0.002 0.002"
        in page.words
    )
    assert "ForceNet, free-running behind PosNet 100 129,794 N 0.777" in page.words


def test_table_two_stands_beside_the_papers_figures(page, evaluation):
    error = evaluation.scores.error[0, :, 0].mean()
    assert re.search(rf"\(1, .1\) {error:#.3g} ± [\d.]+ 1\.07 ", page.words)
    assert "as printed 0.828 0.408 0.685 0.392" in page.words
    assert "as printed 0.435 0.325 0.537 0.201" in page.words
    assert page.words.count("stands still") == 6 + 1


def test_configuration_and_provenance_are_told(page):
    assert "collect: logs: 7" in page.words
    assert "data_hash abc123" in page.words
    assert "seed 3, softfin 0.1.0" in page.words


def test_parts_without_data_are_absent(tmp_path):
    write_report(tmp_path / "empty.html", {})
    page = Page((tmp_path / "empty.html").read_text())
    for absent in ("Table I", "Learning", "Configuration", "Provenance", "None", "std"):
        assert absent not in page.words
    assert "svg" not in page.tags


def test_an_imported_surrogate_has_no_table_one(results, tmp_path):
    write_report(tmp_path / "report.html", {**results, "surrogate": {"scores": None}})
    words = Page((tmp_path / "report.html").read_text()).words
    assert "Table I." not in words
    assert "RMSE" not in words
    assert "Table II, grid" in words


def test_references_of_ones_own_have_no_column_of_the_paper(tmp_path):
    own = evaluate(Flapper(), AnalyticFin(), EvaluateConfig(references=[(0.5, 0)], seconds=3, seeds=1))
    write_report(tmp_path / "report.html", {"controllers": {"single": own.summary()}})
    words = Page((tmp_path / "report.html").read_text()).words
    assert "(0.5, 0)" in words
    assert "as printed" not in words.split("Definitions")[1].split("Control")[-1]
    assert "One seed, hence no intervals" in words
    assert "±" not in words.partition("Definitions")[0]


def test_text_is_escaped(results, tmp_path):
    write_report(tmp_path / "report.html", {**results, "plant": "<script>alert(1)</script>", "title": "a & b"})
    html = (tmp_path / "report.html").read_text()
    assert "<script>" not in html
    assert "<title>a &amp; b</title>" in html
